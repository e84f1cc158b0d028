"""Sweeps: a study at every point of a grid, on worker processes, into a table."""
