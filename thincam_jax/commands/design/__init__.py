"""Searches of a design's file, and the full simulation of the designs found."""
