"""The mask of an experiment file as an object."""

import math
from typing import get_args

import jax
import numpy as np
from jaxtyping import Array

from thincam_jax._core import checks
from thincam_jax.commands.sections import MaskConfig, Relief
from thincam_jax.lensless import masks
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.lensless.propagation.path import Path


def built_mask(config: MaskConfig, exposure: Exposure) -> masks.AbstractMask:
    """The mask of an exposure but for a profile of its own, on its display.

    **Errors**: ValueError for numbers that make none.
    """
    if config.family == "fza":
        return masks.FresnelZoneAperture(
            exposure.beta,
            exposure.phase,
            width=exposure.width,
            height=config.height,
            profile=config.profile,
            pixel_pitch=config.pixel_pitch,
            fill_factor=config.fill_factor,
            harmonics=config.harmonics,
        )
    printed = _printed(config, exposure)
    if config.pixel_pitch is None:
        return printed
    return masks.on_display(printed, config.pixel_pitch, config.fill_factor)


def _printed(config: MaskConfig, exposure: Exposure) -> masks.AbstractMask:
    """Of the families without zones."""
    cell, tiles, height = config.cell or 0.0, config.tiles or 1, config.height
    family = config.family
    if family == "mura":
        return masks.ModifiedUniformlyRedundantArray(config.order or 0, cell, tiles=tiles)
    if family == "ura":
        return masks.UniformlyRedundantArray(config.orders or (0, 0), cell, tiles=tiles)
    if family == "mls":
        code = masks.maximum_length_sequence(config.length or 0)
        return masks.SeparableMask(code, code, cell, combine=config.combine)
    if family == "random":
        key = jax.random.key(config.seed or 0)
        return masks.random_cells(key, config.width, cell, height=height)
    if family == "pinhole":
        return masks.Pinhole(config.width, height)
    if family == "lenslets":
        return masks.LensletArray(config.focal_length or 0.0, cell, config.lenses or (1, 1))
    if family in get_args(Relief):
        smooth = family == "diffuser"
        heights = _heights(config, exposure.wavelength, exposure.distance)
        how = "bilinear" if smooth else "cells"
        return masks.PhaseMask(heights, cell, config.index, interpolation=how)
    amplitude = masks.read_mask(config.path or "", 1.0).amplitude
    return masks.SampledMask(amplitude, config.width / amplitude.shape[1])


def _heights(config: MaskConfig, wavelength: float, distance: float) -> Array:
    """Of a phase mask for objects far away, mm."""
    from thincam_jax import design

    cell = config.cell or 0.0
    count = checks.whole_cells("width", config.width, "cell", cell)
    blank = masks.MaskBlank((count, count), cell, config.index)
    key = jax.random.key(config.seed or 0)
    if config.family == "diffuser":
        length, slope = config.correlation_length or 0.0, config.rms_slope or 0.0
        mask = masks.diffuser(key, blank, correlation_length=length, rms_slope=slope)
    elif config.family == "voronoi_fresnel":
        focal_length, sites = config.focal_length or 0.0, config.sites or 0
        mask = masks.voronoi_fresnel(
            key, blank, sites=sites, focal_length=focal_length, wavelength=wavelength
        )
    else:
        feature, line_width = config.feature or 0.0, config.line_width or 0.0
        lines = design.contour_target(key, blank.grid, feature=feature, line_width=line_width)
        path = Path(*(np.asarray(n, lines.dtype) for n in (wavelength, distance, math.inf)))
        found = design.retrieve_phase(lines, blank.grid, path, shape=blank.shape, key=key)
        any_height = design.one_turn(blank, wavelength)
        mask = design.mask_of_phase(found.phase, blank, wavelength, any_height)
    return mask.height
