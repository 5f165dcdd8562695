"""What train.py is made of: the home of Hydra, files and signals."""
