"""Acquisitions: a plan, its frames in a store, a journal, and resumption."""
