"""Experiments of `kind: screen`: the see-through-screen camera, its ghosts and their removal."""
