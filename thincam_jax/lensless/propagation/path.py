"""The light's path: point source, mask, sensor."""

import functools
import math
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.grids import Grid
from thincam_jax._core.module import Module
from thincam_jax._core.quantity import quantity

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
        if self.at is not None:
            moved = moved + self.distance * self._tangents
        return (grid.y + moved[0]) / scale - centre[0], (grid.x + moved[1]) / scale - centre[1]

    @property
    def moved(self) -> Float[Array, "2"]:
        """(y, x) of the middle of the sensor's samples, mm."""
        if self.at is None or not self.follows:
            return jnp.zeros(2, self.distance.dtype)
        return -self.distance * self._tangents

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
        return bool(np.all(np.asarray(centre) / distance != seen))

    @property
    def _tangents(self) -> Float[Array, "2"]:
        """Tangents of the angles (y, x) at which the point is seen from the axis."""
        assert self.at is not None
        infinite = jnp.isinf(self.object_distance)
        return self.at / jnp.where(infinite, 1.0, self.object_distance)


class ChiefRay(eqx.Module):
    """Unit vector of the ray from a point through the mask's middle: along y, x and the axis."""

    down: Float[Array, ""]
    across: Float[Array, ""]
    cosine: Float[Array, ""]
