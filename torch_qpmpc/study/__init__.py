"""Finished runs, tabulated and drawn."""
