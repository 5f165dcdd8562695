"""Loops compiled for the CPU: over QPs, and over what follows from a theta."""
