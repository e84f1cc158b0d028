"""A comparison of six masks of some seconds, with large pixels."""

import math

import jax
import numpy as np

import thincam_jax as tc
from thincam_jax.design.phase_mask import mask_of_phase, one_turn
from thincam_jax.design.phase_retrieval import contour_target, retrieve_phase
from thincam_jax.imaging.targets import sample_image
from thincam_jax.imaging.targets.patterns import point_grid
from thincam_jax.lensless.masks import MaskBlank
from thincam_jax.lensless.propagation.path import Path
from thincam_jax.studies.mask_captures import ComparedMask, Setting
from thincam_jax.studies.mask_comparison import ComparedScene, MaskComparison, Tuning
from thincam_jax.units import nm, um

WIDTH, DISTANCE, FIELD = 0.744, 2.0, (24, 28)
SETTING = Setting(tc.Sensor((48, 56), 24 * um), DISTANCE, FIELD, WIDTH)
PHASES = tuple(np.arange(4) * math.pi / 2)


def contours() -> tc.PhaseMask:
    """Retrieved for an object far away."""
    blank = MaskBlank((93, 93), 8 * um, 1.52)
    key = jax.random.key(0)
    lines = contour_target(key, blank.grid, feature=200 * um, line_width=24 * um)
    path = Path(*(np.asarray(n, lines.dtype) for n in (550 * nm, DISTANCE, math.inf)))
    found = retrieve_phase(lines, blank.grid, path, shape=blank.shape, key=key)
    return mask_of_phase(found.phase, blank, 550 * nm, one_turn(blank, 550 * nm))


def zones(phase: float = 0.0) -> tc.FresnelZoneAperture:
    return tc.FresnelZoneAperture(100.0, phase, width=WIDTH)


def comparison() -> MaskComparison:
    masks = {
        "pinhole": ComparedMask((tc.Pinhole(48 * um),), "pinhole"),
        "lenslets": ComparedMask((tc.LensletArray(2.0, 248 * um, (3, 3)),), "lenses"),
        "contours": ComparedMask((contours(),), "reliefs"),
        "MURA": ComparedMask((tc.ModifiedUniformlyRedundantArray(31, 24 * um),), "cells"),
        "zone plate": ComparedMask((zones(),), "zones"),
        "four phases": ComparedMask(tuple(map(zones, PHASES)), "zones", "fringe_scanning"),
    }
    camera, astronaut = sample_image("camera", linear=True), sample_image("astronaut", linear=True)
    scenes = {
        "photograph": ComparedScene.of_picture(camera, FIELD),
        "points": ComparedScene.of_picture(point_grid((28, 28), (9, 9)), FIELD, "flat"),
    }
    return MaskComparison(
        SETTING,
        masks,
        scenes,
        Tuning(ComparedScene.of_picture(astronaut, FIELD), (1, 4), 20),
        wavelength=550 * nm,
        band=(500 * nm, 600 * nm),
        light=(1e3, 1e5),
        object_distances=(300.0, 20.0),
        seed=1,
    )
