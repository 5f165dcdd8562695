"""Runs that are killed, and runs that are long: commands, which the tests do not run."""
