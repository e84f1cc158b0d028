"""Experiments of `kind: masks`: one scene after another through masks of all families."""
