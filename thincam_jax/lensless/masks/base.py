"""What a mask must offer to the propagation models."""

import abc
from typing import NamedTuple

import equinox as eqx
from jaxtyping import Array, Complex, Float

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
    def sample(self, grid: Grid) -> Complex[Array, "y x"] | Float[Array, "y x"]:
        """Amplitude transmittance on a grid; cells cut by the aperture count by their open area."""


class ZoneOrders(NamedTuple):
    """A mask as a finite sum of separable chirps over a square array of identical open cells.

    t(x, y) = Σ_k c_k Q_k(x) Q_k(y), Q_k(x) = exp(j k β x²) in the open part of the aperture.

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
