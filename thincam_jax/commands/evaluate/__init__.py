"""Evaluation of solvers over data sets: a worker scores a pair, a folder keeps what has ended."""
