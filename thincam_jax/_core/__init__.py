"""Foundations of every room: checks, files, memory, precision, grids."""
