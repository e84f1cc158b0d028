"""A study's camera in both precisions, with the same numbers."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import PRECISIONS, Precision, allow, cast
from thincam_jax.commands.study.study import Exposure, Study
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.psf import Model, psf


class Conditions(NamedTuple):
    """Camera, wavelength (mm) and object distance (mm) in one precision."""

    camera: LenslessCamera
    wavelength: Array
    object_distance: Array


def conditions_of(study: Study, exposure: Exposure) -> dict[Precision, Conditions]:
    """One exposure in each precision. The numbers are those of float32 in both.

    So a difference between the two is what the arithmetic leaves, not how the numbers are stored.
    """
    found: dict[Precision, Conditions] = {}
    with allow("float64"):
        numbers = (exposure.wavelength, study.object_distance)
        wavelength, distance = (jnp.asarray(np.float32(n)) for n in numbers)
        single = cast(study.camera(exposure), "float32")
        for precision in PRECISIONS:
            found[precision] = Conditions(*cast((single, wavelength, distance), precision))
    return found


def psf_of(
    study: Study,
    exposure: Exposure,
    model: Model = "separable",
    precision: Precision = "float64",
    shape: tuple[int, int] | None = None,
) -> np.ndarray:
    """PSF on the sensor, or on `shape` of its pixels; by default the one that errors count from."""
    with allow(precision):
        camera, wavelength, distance = conditions_of(study, exposure)[precision]
        grid = camera.sensor.grid
        h = psf(
            camera,
            wavelength=wavelength,
            object_distance=float(distance),
            model=model,
            pixel_integration=study.config.pixel_integration,
            grid=Grid(shape, grid.pitch) if shape else grid,
            precision=precision,
        )
    return np.asarray(h)
