"""Theta as the parameters of a module, and the linear MPC schemes it starts from or stays in."""
