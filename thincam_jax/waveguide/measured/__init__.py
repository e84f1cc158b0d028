"""Screens from captures: the rays that fit a measured matrix."""
