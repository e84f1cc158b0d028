"""The light's path: point source, mask, sensor."""

import functools

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.module import Module
from thincam_jax._core.quantity import quantity

_positive_or_infinite = functools.partial(checks.positive, unit="mm", allow_infinity=True)


class Path(Module):
    """A point source on the axis at distance t before the mask, a sensor at d behind it.

    In the Fresnel approximation a spherical wave from t over d acts like a plane wave over d/M,
    magnified by M = (t+d)/t (thesis Eq 3.2): PSF(x; t, d) = PSF(x/M; ∞, d/M).

    - `wavelength`: λ, mm.
    - `distance`: d, mm, > 0.
    - `object_distance`: t, mm, > 0; infinity is a plane wave.
    """

    wavelength: Float[Array, ""] = eqx.field(converter=quantity("mm", check=checks.wavelength))
    distance: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    object_distance: Float[Array, ""] = eqx.field(
        default=jnp.inf, converter=quantity("mm", check=_positive_or_infinite)
    )

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
