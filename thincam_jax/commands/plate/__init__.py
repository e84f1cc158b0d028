"""Designs of see-through screens: `thincam design` of a file of kind screen_design."""
