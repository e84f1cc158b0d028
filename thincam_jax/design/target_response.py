r"""A target frequency response, and how far a design is from it.

A response is told by its **levels**: in rings of frequencies of equal width, from zero up, the mean
signal-to-noise ratio r of `ring_means`, as

.. math:: L = 10 \log_{10}(1 + r)\ \mathrm{dB}.

Well above the noise a level is the ratio in dB; in the noise it is 0, and how far below does not
count. Levels are smooth in every number of a design, as long as the frequencies resolve the
fringes of the responses or average over many of them.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Numbers
from thincam_jax.design.frequencies import Frequencies
from thincam_jax.design.objectives import Channels, channels, ring_means
from thincam_jax.design.setup import Setup
from thincam_jax.design.space import DesignSpace


def ring_levels(known: Channels, frequencies: Frequencies, rings: int) -> Float[Array, " ring"]:
    """10·log₁₀(1 + signal-to-noise ratio) of rings of equal width, dB, from zero frequency up."""
    # log1p keeps the digits of rings deep in the noise, and has a slope there.
    return _decibels(jnp.log1p(ring_means(known, frequencies, rings)))


def response_misfit(
    known: Channels, frequencies: Frequencies, target: Float[Array, " ring"]
) -> Float[Array, ""]:
    """Root mean square over the rings of what levels lack of, or exceed, the target ones, dB."""
    return root_mean_square(ring_levels(known, frequencies, target.shape[0]) - target)


def root_mean_square(difference: Float[Array, " ring"]) -> Float[Array, ""]:
    """With a slope of 0, not NaN, where all is 0."""
    return jnp.sqrt(jnp.mean(difference**2) + jnp.finfo(difference.dtype).eps ** 2)


def _decibels(natural: Float[Array, " ring"]) -> Float[Array, " ring"]:
    return natural * (10 / np.log(10.0))


class ResponseModel(eqx.Module):
    """From points of a space's unit cube to the levels that their designs give.

    - `space`: what is free; `setup`, `synthesis`, `frequencies`: as of `channels`.
    - `rings`: how many levels.
    """

    space: DesignSpace
    setup: Setup
    synthesis: Float[Array, "channel capture"]
    frequencies: Frequencies
    rings: int = eqx.field(static=True)

    def __init__(
        self,
        space: DesignSpace,
        setup: Setup,
        synthesis: Float[Array, "channel capture"] | Float[np.ndarray, "channel capture"],
        frequencies: Frequencies,
        rings: int,
    ):
        if rings < 1:
            raise ValueError(f"rings = {rings}; give at least 1")
        filled = np.unique(frequencies.ring(rings))
        if np.sum(filled < rings) < rings:
            raise ValueError(
                f"rings = {rings}, and the frequencies lie in {np.sum(filled < rings)} of them; "
                "give fewer rings, or more frequencies"
            )
        self.space, self.setup, self.frequencies = space, setup, frequencies
        self.synthesis = jnp.asarray(synthesis, space.base.beta.dtype)
        self.rings = rings

    def levels(self, point: Float[Array, " variable"]) -> Float[Array, " ring"]:
        """Of the design at a point, dB."""
        known = channels(self.space.design(point), self.setup, self.synthesis, self.frequencies)
        return ring_levels(known, self.frequencies, self.rings)

    def misfit(
        self, point: Float[Array, " variable"], target: Float[Array, " ring"]
    ) -> Float[Array, ""]:
        """`response_misfit` of the design at a point, dB."""
        return root_mean_square(self.levels(point) - target)


def checked_levels(target: Numbers, rings: int, dtype: DTypeLike) -> Float[Array, " ring"]:
    """Wanted levels, looked at where they are known: ValueError, one line, for what is none."""
    if checks.is_traced(target):
        levels = jnp.asarray(target).astype(dtype)
    else:
        levels = jnp.asarray(np.asarray(target, dtype=float), dtype)
    if levels.shape != (rings,):
        raise ValueError(
            f"target has shape {levels.shape}; give ({rings},), a level in dB for each ring from "
            "zero frequency up"
        )
    if not checks.is_traced(levels):
        known = np.asarray(levels)
        for bad, what in ((~np.isfinite(known), "no finite number"), (known < 0, "below 0 dB")):
            if bad.any():
                ring = int(np.argmax(bad))
                raise ValueError(
                    f"target level of ring {ring + 1} is {known[ring]:g}, {what}; give levels "
                    "10·log10(1 + ratio) of at least 0 dB, and 0 where nothing is asked for"
                )
    return levels
