"""The see-through-screen camera: a glass plate with two holograms before an ordinary camera.

z runs from the sensor to the object, +y from the top to the bottom hologram. The sensor is at
z = 0, the lens at d0, the plate's rear surface with the bottom hologram at d0 + d1, its front
surface with the top hologram a glass thickness w further, and objects d2 before that (thesis Fig
5.5).
"""

import functools
import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.module import Module
from thincam_jax._core.quantity import FieldError, quantity
from thincam_jax.imaging.refractive_index import AbstractIndex, ConstantIndex, as_index
from thincam_jax.imaging.sensor import Sensor, as_sensor
from thincam_jax.waveguide.hologram import VolumeHologram


class Rectangle(Module):
    """A part of a plane: `centre` and `size` (y, x), mm."""

    centre: Float[Array, "2"] = eqx.field(converter=quantity("mm", shape=(2,)))
    size: Float[Array, "2"] = eqx.field(converter=quantity("mm", shape=(2,)))

    def __check_init__(self):
        if not checks.is_traced(self.size) and not (self.size > 0).all():
            raise ValueError(f"size = {self.size} mm; give a height and a width above 0")

    def holds(self, points: Float[Array, "*point 2"]):
        """Whether points (y, x), mm, lie in it."""
        return (abs(points - self.centre) <= self.size / 2).all(axis=-1)


# Widths of the sensor from it to the lens: what must be m or µm is refused.
_NEAREST, _FURTHEST = 0.03, 1000.0


class Screen(Module):
    """A plane-parallel glass plate with the same hologram at the top and at the bottom.

    - `hologram`: on the front surface before the camera and on the rear surface before the object.
    - `glass_thickness`: w, mm. `glass_index`: index of the plate.
    - `top`, `bottom`: extents of the holograms, mm from the camera's axis; None: everywhere.
    - `cover`: black tape on the front surface, which stops light that would come straight through
      the plate to the camera; None for none.
    """

    hologram: VolumeHologram = eqx.field(
        converter=functools.partial(
            checks.instance, "hologram", VolumeHologram, "a waveguide.VolumeHologram"
        )
    )
    glass_thickness: Float[Array, ""] = eqx.field(
        converter=quantity("mm", positive=True, most=100.0)
    )
    glass_index: AbstractIndex = eqx.field(converter=quantity(check=as_index))
    top: Rectangle | None = None
    bottom: Rectangle | None = None
    cover: Rectangle | None = None


def _two(unit: str) -> Any:
    def check(name: str, value: Any) -> Array:
        return checks.finite(name, np.zeros(2) if value is None else value, unit, shape=(2,))

    return quantity(unit, check=check)


class SeeThroughCamera(Module):
    """A screen and the camera behind its top hologram.

    - `focal_distance`: d0, from the sensor to the lens, mm.
    - `lens_distance`: d1, from the lens to the plate's rear surface, mm.
    - `tilt`: angles of the plate against the camera, about x and then about y, rad; None for none.
      It turns about where the camera's axis meets its rear surface; the object's plane stays.
    - `aperture`: diameter of the thin lens, mm; 0: a pinhole, which shows all distances sharply.
    - `focus_distance`: from the lens to what it shows sharply without the screen, mm; None for
      infinity.
    - `direct_band`: width, mm, of the band of colours in which light straight through the plate is
      as bright to the sensor as the object; 0 where black tape lets none through.
    - `lens_point`: (y, x) where rays cross the lens, mm; None: its middle. `lens_views` sets it.
    """

    screen: Screen = eqx.field(
        converter=functools.partial(checks.instance, "screen", Screen, "a waveguide.Screen")
    )
    sensor: Sensor = eqx.field(converter=as_sensor)
    focal_distance: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    lens_distance: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    tilt: Float[Array, "2"] = eqx.field(default=None, converter=_two("rad"))
    aperture: Float[Array, ""] = eqx.field(default=0.0, converter=quantity("mm", non_negative=True))
    focus_distance: Float[Array, ""] | None = eqx.field(
        default=None, converter=quantity("mm", positive=True, optional=True)
    )
    direct_band: Float[Array, ""] = eqx.field(
        default=0.0, converter=quantity("mm", non_negative=True)
    )
    lens_point: Float[Array, "2"] = eqx.field(default=None, converter=_two("mm"))

    def __check_init__(self):
        if checks.holds_traced((self.focal_distance, self.sensor)):
            return
        focal, wide = float(self.focal_distance), self.sensor.shape[1] * float(self.sensor.pitch)
        if not _NEAREST * wide < focal < _FURTHEST * wide:
            raise FieldError(
                f"focal_distance = {focal:g} mm: a sensor {wide:.3g} mm wide sees "
                f"{2 * math.degrees(math.atan(wide / 2 / focal)):.3g}°; give lengths in mm",
                "focal_distance",
            )

    @property
    def plate_axes(self) -> Float[Array, "3 3"]:
        """Columns: the plate's axes and its normal, in the camera's x, y, z."""
        (cos_x, cos_y), (sin_x, sin_y) = jnp.cos(self.tilt), jnp.sin(self.tilt)
        rows = (
            (cos_y, sin_y * sin_x, sin_y * cos_x),
            (jnp.zeros_like(cos_x), cos_x, -sin_x),
            (-sin_y, cos_y * sin_x, cos_y * cos_x),
        )
        return jnp.stack([jnp.stack(row) for row in rows])


class ObjectPlane(Module):
    """A flat object before the screen, of square cells of uniform radiance, as those of a monitor.

    - `shape`: (rows, columns) of cells.
    - `distance`: d2, from the plate's front surface, mm.
    - `width`: width of the object, mm.
    - `centre`: (y, x) of its middle from the camera's axis, mm; +y is down.
    """

    shape: tuple[int, int] = eqx.field(converter=quantity(check=checks.shape2d), static=True)
    distance: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    width: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    centre: Float[Array, "2"] = eqx.field(converter=quantity("mm", shape=(2,)))

    @property
    def pitch(self) -> Float[Array, ""]:
        """Side of the cells, mm."""
        return self.width / self.shape[1]

    @property
    def extent(self) -> Rectangle:
        """Outline of all cells."""
        return Rectangle(self.centre, self.pitch * np.asarray(self.shape, self.width.dtype))


def seen_size(camera: SeeThroughCamera, plane: ObjectPlane) -> Float[Array, ""]:
    """Side of the square of the object's plane that a pixel sees, mm."""
    return camera.sensor.pitch * (camera.lens_distance + plane.distance) / camera.focal_distance


def without_dispersion(camera: SeeThroughCamera) -> SeeThroughCamera:
    """The camera whose indices are, at every wavelength, those of its middle's colour."""
    screen = camera.screen
    wavelength, _ = screen.hologram.bragg_wavelength(jnp.zeros(2, camera.sensor.pitch.dtype))
    indices = (screen.hologram.index, screen.glass_index)
    constant = [ConstantIndex(index(wavelength)) for index in indices]
    return eqx.tree_at(lambda c: (c.screen.hologram.index, c.screen.glass_index), camera, constant)
