"""Benchmarks of a study's models: what they cost, how far off they are and what that does."""
