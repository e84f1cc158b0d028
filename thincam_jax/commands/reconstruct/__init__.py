"""Reconstructing captures from their files: read, prepare, reconstruct, write, keep a record."""
