"""The lensless camera: a mask at a distance before a sensor."""

import functools
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number
from thincam_jax._core.module import Module
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.propagation.path import Path


class LenslessCamera(Module):
    """A coded mask in the plane z = 0 and a sensor at z = `distance`; objects at z < 0.

    - `mask`: any mask; see `thincam_jax.lensless.masks`.
    - `sensor`: shape and pitch of the pixels.
    - `distance`: mask-sensor distance d, mm, > 0.
    """

    mask: AbstractMask
    sensor: Sensor
    distance: Float[Array, ""]

    def __init__(self, mask: Any, sensor: Any, distance: Number):
        if not isinstance(mask, AbstractMask):
            raise TypeError(
                f"mask is a {type(mask).__name__}; give a mask, such as a FresnelZoneAperture"
            )
        if not isinstance(sensor, Sensor):
            raise TypeError(f"sensor is a {type(sensor).__name__}; give a thincam_jax.Sensor")
        self.mask = mask
        self.sensor = sensor
        self.distance = checks.positive("distance", distance, "mm")

    def path(self, wavelength: Number, object_distance: Number) -> Path:
        """The light's path from a point at `object_distance` (mm) in front of the mask."""
        # Plain numbers take the camera's precision, so that float32 cameras stay float32. In NumPy,
        # they stay known inside jit.
        like = functools.partial(np.asarray, dtype=self.distance.dtype)
        wavelength = like(wavelength) if isinstance(wavelength, int | float) else wavelength
        if isinstance(object_distance, int | float):
            object_distance = like(object_distance)
        return Path(wavelength, self.distance, object_distance)
