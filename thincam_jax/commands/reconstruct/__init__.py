"""Reconstructing captures from their files: read, prepare, reconstruct, write, keep a record."""

# What works from a measured PSF and prepared captures; "auto" then is admm-tv.
METHODS = ("auto", "admm-tv", "fista", "pnp", "ridge")
