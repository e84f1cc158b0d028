"""Acquisitions: a plan, its frames in a store, a journal, and how it goes on after anything."""
