r"""Where a response is looked at: points and weights of an integral over angular frequencies.

Angular frequencies ν, in cycles/rad, belong to the object and are the same for captures at every
distance d: on a sensor at d they are ν/d cycles/mm.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.polynomial.legendre import leggauss

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number


@checked
class Quadrant(eqx.Module):
    r"""A square of frequencies ν_x, ν_y ≥ 0 that stands for the whole plane.

    The response of a centred zone aperture is even in both, so that n² samples are those of a
    (2n − 1)² image. Samples must be closer than half the inverse of the mask's width as seen from
    the sensor, d/(2·width): else the uniform background falls between them
    and its variance is missed. Where the whole band would need `even` samples and there are fewer,
    they are that close at zero only, at :math:`\nu \propto \sinh(bi)`: finer rings average out, and
    an error is off by less than 0.01 dB for 256 samples.

    - `axis`: ν from zero up, cycles/rad, along either axis.
    - `weight`: area that each point stands for, so that Σ w g is ∬ g dν_x dν_y over the plane.
    - `bend`: b (n − 1); 0 for even samples.
    """

    axis: Float[Array, " n"]
    weight: Float[Array, "n n"]
    bend: float = eqx.field(static=True)

    def __init__(self, highest: Number, count: int = 512, even: int = 0):
        """`highest`: the band's end along an axis, cycles/rad; `count`: samples along it."""
        if count < 2:
            raise ValueError(f"count = {count}: give at least 2 frequencies")
        highest = checks.positive("highest", highest, "cycles/rad")
        self.axis = highest * jnp.linspace(0.0, 1.0, count, dtype=highest.dtype)
        along = jnp.full(count, 2.0, self.axis.dtype).at[0].set(1.0)
        self.weight = along[:, None] * along * (self.axis[1] - self.axis[0]) ** 2
        self.bend = _bend((even - 1) / (count - 1))
        if self.bend:
            middles = np.minimum(np.arange(count) + 0.5, count - 1)  # no wider than the band
            cells = 2 * np.diff(_places(middles, count, self.bend), prepend=0.0)
            along = highest * jnp.asarray(cells, highest.dtype)
            self.axis = highest * jnp.asarray(self._places, highest.dtype)
            self.weight = along[:, None] * along

    @property
    def _places(self) -> np.ndarray:
        """Parts of the highest frequency."""
        count = len(self.axis)
        return _places(np.arange(count), count, self.bend)

    @property
    def squared(self) -> Float[Array, "n n"]:
        """|ν|² at each point."""
        return self.axis[:, None] ** 2 + self.axis**2

    @property
    def highest(self) -> Float[Array, ""]:
        """The end of the band, cycles/rad."""
        return self.axis[-1]

    def ring(self, rings: int) -> Int[np.ndarray, " point"]:
        """Ring of each point, of `rings` up to the highest frequency; number `rings` in corners."""
        place = self._places
        radius = np.hypot(place[:, None], place).ravel()
        return np.where(radius < 1, np.minimum(radius * rings, rings - 1), rings).astype(int)


def _places(number: np.ndarray, count: int, bend: float) -> np.ndarray:
    """Places of numbered samples, the last of `count` at 1."""
    part = number / (count - 1)
    return np.sinh(bend * part) / np.sinh(bend) if bend else part


def _bend(ratio: float) -> float:
    """b for which the mean spacing sinh(b)/b is so many times that at zero; 0 for less than 1."""
    if ratio <= 1:
        return 0.0
    bends = np.geomspace(1e-3, 50.0, 5000)
    return float(np.interp(np.log(ratio), np.log(np.sinh(bends) / bends), bends))


@checked
class Polar(eqx.Module):
    r"""Radii and directions: a response whose fringes are rings needs few directions.

    Directions are Gauss-Legendre nodes of an octant, which stands for all eight.

    - `radius`: |ν|, cycles/rad; `cosine`, `sine`: components of each direction.
    - `weight`: so that Σ w g is ∬ g dν_x dν_y over the disc.
    """

    radius: Float[Array, " n"]
    cosine: Float[Array, " m"]
    sine: Float[Array, " m"]
    weight: Float[Array, "m n"]

    def __init__(self, highest: Number, count: int = 2048, directions: int = 4):
        """`highest`: the disc's radius, cycles/rad; `count`: radii, at the middles of rings."""
        if count < 2 or directions < 1:
            raise ValueError(
                f"count = {count}, directions = {directions}: give at least 2 radii, 1 direction"
            )
        highest = checks.positive("highest", highest, "cycles/rad")
        nodes, weights = leggauss(directions)
        angle = np.pi / 8 * (nodes + 1)
        self.cosine = jnp.asarray(np.cos(angle), highest.dtype)
        self.sine = jnp.asarray(np.sin(angle), highest.dtype)
        self.radius = highest * (jnp.arange(count, dtype=highest.dtype) + 0.5) / count
        rings = 2 * jnp.pi * self.radius * (highest / count)
        self.weight = jnp.asarray(weights / 2, highest.dtype)[:, None] * rings

    @property
    def squared(self) -> Float[Array, "m n"]:
        """|ν|² at each point."""
        return jnp.broadcast_to(self.radius**2, self.weight.shape)

    @property
    def highest(self) -> Float[Array, ""]:
        """The end of the band, cycles/rad."""
        return self.radius[-1] + 0.5 * (self.radius[1] - self.radius[0])

    def ring(self, rings: int) -> Int[np.ndarray, " point"]:
        """Ring of each point, of `rings` up to the highest frequency."""
        place = (np.arange(len(self.radius)) + 0.5) / len(self.radius)
        return np.tile((place * rings).astype(int), len(self.cosine))


Frequencies = Quadrant | Polar
