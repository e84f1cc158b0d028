"""Depth from captures: refocusing after the event, distances, depth maps, sharp pictures.

A mask's shadow grows with M = 1 + d/t: a capture encodes the distance t of its objects.
`refocus_sweep` reconstructs at many t, the focus measures show which image is sharp, and
`axial_resolution` is the least difference of distances that can be resolved.
"""

from thincam_jax.reconstruction.depth.find import all_in_focus as all_in_focus
from thincam_jax.reconstruction.depth.find import depth_map as depth_map
from thincam_jax.reconstruction.depth.find import find_distances as find_distances
from thincam_jax.reconstruction.depth.refocus import axial_resolution as axial_resolution
from thincam_jax.reconstruction.depth.refocus import refocus_distances as refocus_distances
from thincam_jax.reconstruction.depth.refocus import refocus_sweep as refocus_sweep
