"""A lensless camera, and the light's path through it: point source, mask and sensor."""

import functools
import math
from dataclasses import replace

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

_positive_or_infinite = functools.partial(checks.positive, unit="mm", allow_infinity=True)


class LightPath(Module):
    r"""A point source at distance t before the mask, a sensor at d behind it.

    In the Fresnel approximation a spherical wave from t over d acts like a plane wave over d/M,
    magnified by M = (t+d)/t (thesis Eq 3.2): PSF(x; t, d) = PSF(x/M; ∞, d/M).

    Off the axis the waves are expanded to second order about the chief ray, the one through the
    mask's middle, with the unit vector (s, c), s across the axis. The light on a point u of the
    mask's scale is then

    .. math::
        U(\mathbf u) = \frac{\sqrt{\det B}}{j\pi} \int t(\pmb\xi)\,
            e^{j(\mathbf u-\pmb\xi)^T B (\mathbf u-\pmb\xi)}\,d^2\xi,
        \qquad B = \frac{\pi M c}{\lambda d}\,(I - \mathbf s\mathbf s^T)

    for d/c along the ray: d/c³ in the plane of incidence and d/c across it, the same M.

    - `wavelength`: λ, mm.
    - `distance`: d, mm, > 0.
    - `object_distance`: t, mm, > 0; infinity is a plane wave.
    - `at`: (y, x) of the point, mm; of a plane wave, the tangents of its angles. None on the axis.
    - `sine`: sine of the ray's angle in the plane of one axis, for a path along it, see
      `along_axes`; None where the ray is the axis.
    - `skew`: whether the point is, or may be, off both of the mask's axes.
    - `follows`: whether the middle of the sensor's samples is where the ray through the mask's
      plane at (0, 0) meets it, in place of the axis.
    - `place`: (y, x) of the camera's axis in the frame of `at`, mm: a point is seen from there.
    """

    wavelength: Float[Array, ""] = eqx.field(converter=quantity("mm", check=checks.wavelength))
    distance: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    object_distance: Float[Array, ""] = eqx.field(
        default=jnp.inf, converter=quantity("mm", check=_positive_or_infinite)
    )
    at: Float[Array, "2"] | None = eqx.field(
        default=None, converter=quantity("mm", shape=(2,), optional=True)
    )
    sine: Float[Array, ""] | None = None
    skew: bool = eqx.field(default=False, static=True)
    follows: bool = eqx.field(default=False, static=True)
    place: Float[Array, "2"] | None = None

    @property
    def magnification(self) -> Float[Array, ""]:
        """M = 1 + d/t: the shadow's size over the mask's."""
        return 1 + self.distance / self.object_distance

    @property
    def fresnel_curvature(self) -> Float[Array, ""]:
        """b = πM/(λd), rad/mm²: of the plane wave over d/M that acts like the spherical one."""
        return jnp.pi * self.magnification / self.wavelength / self.distance

    def epsilon(self, beta: Float[Array, ""]) -> Float[Array, ""]:
        """ε = βλd/(πM), the strength of diffraction; at ε = 1 order −1 focuses on the sensor."""
        return beta * self.wavelength * self.distance / (jnp.pi * self.magnification)

    def detour(self, u: Float[Array, "..."]) -> Float[Array, "..."]:
        r"""The distance from a point of the mask, to second order, at which the wave turns as at u.

        A sphere about a point at L = dc²/M along an oblique path of d/c³ reaches u with the phase
        of :math:`b w^2`,

        .. math:: w^2 = \frac{2L\,u^2}{\sqrt{L^2 + 2Lsu + u^2} + L + su}

        exactly in the plane of incidence. Written so that nothing cancels, and over its value for
        s = 0: what second order leaves out on the axis, it leaves out here. To third order
        :math:`w^2 = u^2 (1 - su/L)`.
        """
        if self.sine is None:
            return u
        length = self.distance * (1 - self.sine**2) / self.magnification
        ray, axis = jnp.sqrt(length**2 + 2 * length * self.sine * u + u**2), jnp.hypot(length, u)
        return u * jnp.sqrt((axis + length) / (ray + length + self.sine * u))

    def on_mask(
        self, grid: Grid, centre: Float[Array, "2"]
    ) -> tuple[Float[Array, " rows"], Float[Array, " columns"]]:
        """Rows and columns of the sensor on the mask's scale, from the middle of its shadow."""
        scale, moved = self.magnification, self.moved
        if self.at is not None or self.place is not None:
            moved = moved + self.distance * self._tangents
        return (grid.y + moved[0]) / scale - centre[0], (grid.x + moved[1]) / scale - centre[1]

    @property
    def moved(self) -> Float[Array, "2"]:
        """(y, x) of the middle of the sensor's samples, mm."""
        if self.at is None or not self.follows:
            return jnp.zeros(2, self.distance.dtype)
        return -self.distance * self._seen

    def chief_ray(self, centre: Float[Array, "2"]) -> "ChiefRay | None":
        """Ray from the point through a mask's `centre` (y, x), mm; None on the axis."""
        if self.at is None:
            return None
        slopes = centre / self.object_distance - self._tangents
        cosine = 1 / jnp.sqrt(1 + jnp.sum(slopes**2))
        return ChiefRay(slopes[0] * cosine, slopes[1] * cosine, cosine)

    def along_axes(self, centre: Float[Array, "2"]) -> tuple["LightPath", "LightPath"]:
        r"""The paths on the axis whose waves are those along y and along x, of the same M.

        Their distances are :math:`\tfrac dc(1 + s_i^2/c^2)`: the diagonal of B⁻¹. For a point on
        one of the mask's axes the waves are products of the two.
        """
        ray = self.chief_ray(centre)
        if ray is None:
            return self, self
        infinite = jnp.isinf(self.object_distance)
        near = jnp.where(infinite, 1.0, self.object_distance)
        stretched = ((s, (1 + (s / ray.cosine) ** 2) / ray.cosine) for s in (ray.down, ray.across))
        down, across = (
            replace(
                self,
                distance=self.distance * n,
                object_distance=jnp.where(infinite, jnp.inf, near * n),
                at=None,
                sine=sine,
                place=None,
            )
            for sine, n in stretched
        )
        return down, across

    def is_skew(self, centre: Float[Array, "2"]) -> bool:
        """Whether the chief ray is oblique to both axes of a mask; True of traced numbers."""
        if self.at is None:
            return False
        if any(map(checks.is_traced, (self.at, self.object_distance, centre))):
            return True
        distance = float(np.asarray(self.object_distance))
        seen = np.asarray(self.at) / (1.0 if math.isinf(distance) else distance)
        middle = np.asarray(centre) + (0.0 if self.place is None else np.asarray(self.place))
        return bool(np.all(middle / distance != seen))

    @property
    def _seen(self) -> Float[Array, "2"]:
        """Tangents of the point's angles (y, x) from the origin of its frame; 0 on the axis."""
        if self.at is None:
            return jnp.zeros(2, self.distance.dtype)
        infinite = jnp.isinf(self.object_distance)
        return self.at / jnp.where(infinite, 1.0, self.object_distance)

    @property
    def _tangents(self) -> Float[Array, "2"]:
        """Tangents of the angles (y, x) at which the point is seen from the camera's axis."""
        return self._seen if self.place is None else self._seen - self.place / self.object_distance


class ChiefRay(eqx.Module):
    """Unit vector of the ray from a point through the mask's middle: along y, x and the axis."""

    down: Float[Array, ""]
    across: Float[Array, ""]
    cosine: Float[Array, ""]


# Relative L2 error of a zone plate's PSF for a radian of phase left out at the mask's edge.
ERROR_PER_RADIAN = 0.22


def shift_variance(
    wavelength: float, distance: float, frequency: float, cosine: float | Float[np.ndarray, "..."]
):
    r"""Phase by which the PSF's change over the field turns the light of a frequency ν, rad.

    In the plane of incidence the light travels d/c³ in place of d: :math:`\pi\lambda d\nu^2
    (c^{-3} - 1)`.
    """
    return math.pi * wavelength * distance * frequency**2 * (cosine**-3 - 1)


def psf_change(wavelength: float, distance: float, frequency: float, cosine: float) -> float:
    r"""Relative L2 error, about, of taking the PSF of the axis off it.

    :math:`2 \cdot 0.22 \sin(\varphi/2)` of the phase φ by which the finest light of the mask
    differs (`shift_variance`), at most π; the edges of a small mask add some percent of their own.
    """
    phase = shift_variance(wavelength, distance, frequency, cosine)
    return 2 * ERROR_PER_RADIAN * math.sin(min(phase, math.pi) / 2)


class LenslessCamera(Module):
    """A coded mask in the plane z = 0 and a sensor at z = `distance`; objects at z < 0.

    - `mask`: any mask; see `thincam_jax.lensless.masks`.
    - `sensor`: shape and pitch of the pixels.
    - `place`: (y, x) of the camera's axis in the scene, mm, by default (0, 0): a part of a `Mosaic`
      sees near objects from beside the scene's axis, and they move by d/t of it on the sensor.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    h = tc.psf(camera, wavelength=500 * nm, object_distance=250.0)
    print(h.shape)  # (24, 32)
    ```

    **See also**: `FresnelZoneAperture`, `Sensor`, `psf`, `capture`, `Mosaic`.
    """

    mask: AbstractMask = eqx.field(
        converter=functools.partial(
            checks.instance, "mask", AbstractMask, "a mask, such as a FresnelZoneAperture"
        )
    )
    sensor: Sensor = eqx.field(converter=as_sensor)
    distance: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    place: Float[Array, "2"] | None = eqx.field(
        default=None, converter=quantity("mm", shape=(2,), optional=True), kw_only=True
    )

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
            return LightPath(wavelength, self.distance, object_distance, place=self.place)
        on_an_axis = self._knows_axis(at)
        if isinstance(at, tuple | list):
            if all(isinstance(n, int | float) for n in at):
                at = like(at)
            elif any(map(checks.is_traced, at)):
                at = jnp.stack([jnp.asarray(n, self.distance.dtype) for n in at])
        path = LightPath(wavelength, self.distance, object_distance, at, place=self.place)
        convert = jnp.asarray if checks.is_traced(path.at) else np.asarray
        path = replace(path, at=convert(path.at, dtype=self.distance.dtype))
        return replace(path, skew=not on_an_axis and path.is_skew(self.mask.centre))

    def _knows_axis(self, at: Position) -> bool:
        """Whether one coordinate of a point is known to be 0, and the mask's to be 0, too."""
        centre = self.mask.centre
        if self.place is not None or checks.is_traced(centre) or not isinstance(at, tuple | list):
            return False
        pairs = zip(at, np.asarray(centre), strict=False)  # other lengths are refused by the path
        return any(isinstance(n, int | float) and n == c == 0 for n, c in pairs)
