"""Theta as the parameters of a module that starts as a linear MPC scheme, and may stay one."""
