"""The lensless camera: a mask at a distance before a sensor."""

import functools
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Position
from thincam_jax._core.grids import Grid
from thincam_jax._core.module import Module
from thincam_jax._core.quantity import quantity
from thincam_jax.imaging.sensor import Sensor, as_sensor
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.propagation.path import LightPath


def _mask(given: Any) -> AbstractMask:
    if not isinstance(given, AbstractMask):
        raise TypeError(
            f"mask is a {type(given).__name__}; give a mask, such as a FresnelZoneAperture"
        )
    return given


class LenslessCamera(Module):
    """A coded mask in the plane z = 0 and a sensor at z = `distance`; objects at z < 0.

    - `mask`: any mask; see `thincam_jax.lensless.masks`.
    - `sensor`: shape and pitch of the pixels.
    - `distance`: mask-sensor distance d, mm, > 0.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    h = tc.psf(camera, wavelength=500 * nm, object_distance=250.0)
    print(h.shape)  # (24, 32)
    ```

    **See also**: `FresnelZoneAperture`, `Sensor`, `psf`, `capture`.
    """

    mask: AbstractMask = eqx.field(converter=_mask)
    sensor: Sensor = eqx.field(converter=as_sensor)
    distance: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))

    def _repr_png_(self) -> bytes:
        """Picture for notebooks: the mask, and the camera from the side."""
        from thincam_jax.plot.frame import as_png
        from thincam_jax.plot.objects import draw_camera

        return as_png(draw_camera(self))

    def on_grid(self, grid: Grid) -> "LenslessCamera":
        """The camera with the pixels of a grid in place of the sensor's."""
        return replace(self, sensor=Sensor(grid.shape, grid.pitch))

    def path(
        self, wavelength: Number, object_distance: Number, at: Position | None = None
    ) -> LightPath:
        """The light's path from a point `object_distance` (mm) before the mask, as `psf` has it."""
        # Plain numbers take the camera's precision, so that float32 cameras stay float32. In NumPy,
        # they stay known inside jit.
        like = functools.partial(np.asarray, dtype=self.distance.dtype)
        wavelength = like(wavelength) if isinstance(wavelength, int | float) else wavelength
        if isinstance(object_distance, int | float):
            object_distance = like(object_distance)
        if at is None:
            return LightPath(wavelength, self.distance, object_distance)
        on_an_axis = self._knows_axis(at)
        if isinstance(at, tuple | list):
            if all(isinstance(n, int | float) for n in at):
                at = like(at)
            elif any(map(checks.is_traced, at)):
                at = jnp.stack([jnp.asarray(n, self.distance.dtype) for n in at])
        path = LightPath(wavelength, self.distance, object_distance, at)
        convert = jnp.asarray if checks.is_traced(path.at) else np.asarray
        path = replace(path, at=convert(path.at, dtype=self.distance.dtype))
        return replace(path, skew=not on_an_axis and path.is_skew(self.mask.centre))

    def _knows_axis(self, at: Position) -> bool:
        """Whether one coordinate of a point is known to be 0, and the mask's to be 0, too."""
        centre = self.mask.centre
        if checks.is_traced(centre) or not isinstance(at, tuple | list):
            return False
        pairs = zip(at, np.asarray(centre), strict=False)  # other lengths are refused by the path
        return any(isinstance(n, int | float) and n == c == 0 for n, c in pairs)
