"""Depth from captures: refocusing after the event, distances, depth maps, sharp pictures.

A mask's shadow grows with M = 1 + d/t: a capture holds the distance t of what it shows.
`refocus_sweep` reconstructs at many t, the focus measures say which one is sharp, and
`axial_resolution` how far apart two distances must be to be told apart at all.
"""

from .find import FocusCurves as FocusCurves
from .find import FocusPeak as FocusPeak
from .find import find_distances as find_distances
from .find import object_regions as object_regions
from .focus import MEASURES as MEASURES
from .focus import focus_measure as focus_measure
from .maps import DepthMap as DepthMap
from .maps import all_in_focus as all_in_focus
from .maps import depth_map as depth_map
from .refocus import RefocusSweep as RefocusSweep
from .refocus import refocus_sweep as refocus_sweep
from .resolution import axial_resolution as axial_resolution
from .resolution import refocus_distances as refocus_distances
