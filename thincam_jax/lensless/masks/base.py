"""What a mask must offer to the propagation models."""

import abc
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core.checks import Number
from thincam_jax._core.grids import Grid


class AbstractMask(eqx.Module):
    """A thin mask in the plane z = 0, given by its amplitude transmittance.

    - `centre`: (y, x) of the mask's centre relative to the optical axis, mm.

    Every mask can be sampled on a grid; that is all that `angular_spectrum` and
    `rayleigh_sommerfeld` ask for. Masks with separable zone orders also offer `zone_orders`.
    """

    centre: eqx.AbstractVar[Float[Array, "2"]]

    @property
    @abc.abstractmethod
    def extent(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Height and width of the open aperture, mm."""

    @abc.abstractmethod
    def sample(
        self, grid: Grid, wavelength: Number | None = None
    ) -> Complex[Array, "y x"] | Float[Array, "y x"]:
        """Amplitude transmittance on a grid; cells cut by the aperture count by their open area.

        `wavelength`: mm, of the light; a mask whose transmittance is the same for all takes none.
        """


class ZoneOrders(NamedTuple):
    """A mask along one axis, as a finite sum of separable chirps over an array of open cells.

    t(x, y) = Σ_k c_k Q_k(x) Q_k(y), Q_k(x) = exp(j k β x²) in the open part of the aperture. The
    axes of a square share one; those of a rectangle differ in the cells alone.

    - `orders`: the k, static.
    - `coefficients`: the c_k, complex.
    - `beta`: β, rad/mm².
    - `lower`, `upper`: ends of the open cells along an axis, mm, relative to the mask's centre.
    - `sites`: None where the chirp is continuous; else the coordinate of each cell, which has
      the constant chirp value of that coordinate (a pixelated display).
    """

    orders: tuple[int, ...]
    coefficients: Complex[Array, " order"]
    beta: Float[Array, ""]
    lower: Float[Array, " cell"]
    upper: Float[Array, " cell"]
    sites: Float[Array, " cell"] | None


def require_zone_orders(mask: AbstractMask, model: str, axis: int = 1) -> ZoneOrders:
    """The mask's zone orders along x (or y, axis 0), or one line that says which models can be used
    without."""
    zone_orders = getattr(mask, "zone_orders", None)
    if zone_orders is None:
        raise TypeError(
            f"model {model!r} needs a mask made of zone orders, such as FresnelZoneAperture; for a "
            f"{type(mask).__name__} use 'angular_spectrum' or 'rayleigh_sommerfeld'"
        )
    return zone_orders(axis)


def axis_orders(mask: AbstractMask, model: str) -> tuple[ZoneOrders, ZoneOrders]:
    """The zone orders along y and along x; one object for both where the mask is a square."""
    columns = require_zone_orders(mask, model)
    square = getattr(mask, "height", None) is None
    return columns if square else require_zone_orders(mask, model, axis=0), columns


def pairs(zones: ZoneOrders) -> tuple[np.ndarray, np.ndarray, Complex[Array, " pair"]]:
    """All pairs k ≤ l of orders and their weights, so that |Σ c_k A_k|² = Re Σ w_kl A_k A_l*."""
    first, second = np.triu_indices(len(zones.orders))
    c = zones.coefficients
    double = np.where(first == second, 1.0, 2.0).astype(c.dtype)
    return first, second, c[first] * c[second].conj() * double
