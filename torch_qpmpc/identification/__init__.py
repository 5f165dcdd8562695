"""Linear models with their noise, from logs of a plant."""
