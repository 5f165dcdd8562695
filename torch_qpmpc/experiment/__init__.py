"""The parts of train.py: configuration, tasks, run folders and sweeps."""
