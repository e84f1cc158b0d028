r"""Designs whose response is nearest to a target response, by least squares from many starts.

A response is given by its **levels**: in rings of frequencies of equal width, from zero up, the
mean signal-to-noise ratio r of `ring_means`, as

.. math:: L = 10 \log_{10}(1 + r)\ \mathrm{dB}.

Well above the noise a level is the ratio in dB; in the noise it is 0, and how far below does not
count. Levels are smooth in every number of a design, as long as the frequencies resolve the
fringes of the responses or average over many of them. The search minimises

.. math:: \min_p \frac1R \sum_{r=1}^R [L_r(p) - L_r^{target}]^2

over the unit cube of a space, by Levenberg and Marquardt's method: the misfit is a sum of squares,
and R levels say more of the direction than their sum.
"""

import functools
from dataclasses import dataclass
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Numbers
from thincam_jax._core.module import Module
from thincam_jax._core.progress import watched
from thincam_jax._core.random import Key, random_key
from thincam_jax.design.design import Design
from thincam_jax.design.objectives import Channels, channels, ring_means
from thincam_jax.design.search import (
    SEPARATION,
    Descents,
    Found,
    best_apart,
    on_cube,
    sampled,
    search_of,
)
from thincam_jax.design.setup import Frequencies, Setup
from thincam_jax.design.space import DesignSpace


@checked
def ring_levels(known: Channels, frequencies: Frequencies, rings: int) -> Float[Array, " ring"]:
    """10·log₁₀(1 + signal-to-noise ratio) of rings of equal width, dB, from zero frequency up."""
    # log1p keeps the digits of rings deep in the noise, and has a slope there.
    return (10 / np.log(10.0)) * jnp.log1p(ring_means(known, frequencies, rings))


@checked
def response_misfit(
    known: Channels, frequencies: Frequencies, target: Float[Array, " ring"]
) -> Float[Array, ""]:
    """Root mean square over the rings of what levels lack of, or exceed, the target ones, dB."""
    return root_mean_square(ring_levels(known, frequencies, target.shape[0]) - target)


def root_mean_square(difference: Float[Array, " ring"]) -> Float[Array, ""]:
    """Root mean square over the rings, with a slope of 0, not NaN, where all is 0."""
    return jnp.sqrt(jnp.mean(difference**2) + jnp.finfo(difference.dtype).eps ** 2)


@checked
class ResponseModel(eqx.Module):
    """Response levels of the designs at points of a space's unit cube.

    - `space`: numbers that are free; `setup`, `synthesis`, `frequencies`: arguments of `channels`.
    - `rings`: number of levels.

    **Errors**: ValueError for rings below 1, or of which some hold no frequency.
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
        rings: int = 32,
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
        """Ring levels of the design at a point, dB."""
        known = channels(self.space.design(point), self.setup, self.synthesis, self.frequencies)
        return ring_levels(known, self.frequencies, self.rings)

    def misfit(
        self, point: Float[Array, " variable"], target: Float[Array, " ring"]
    ) -> Float[Array, ""]:
        """`response_misfit` of the design at a point, dB."""
        return root_mean_square(self.levels(point) - target)


def checked_levels(target: Numbers, rings: int, dtype: DTypeLike) -> Float[Array, " ring"]:
    """Wanted levels, checked if they are known: ValueError, one line, for others."""
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
                    "10·log10(1 + ratio) of at least 0 dB; 0 dB is no response"
                )
    return levels


MatchStatus = Literal["matched", "not_attained", "non_finite"]
# Misfits up to here count as matched, dB.
MATCHED = 1.0
# Levenberg and Marquardt's damping begins at 1: of residuals in hundredths of a dB that is weak.
_WEIGHT = 100.0


@checked
@dataclass(frozen=True)
class MatchSettings:
    """Length of a search for a response.

    - `starts`: descents (optimistix' Levenberg-Marquardt under the smooth map sin² onto the cube);
      `samples`: points of the even sampling before, from the best of which they start.
    - `steps`: at most, of each descent; it ends where a step changes the misfit by less than
      `tolerance` of itself.
    - `tolerance_db`: misfits up to here are "matched".
    - `separation`: optima closer than this in the cube are one.

    **Errors**: ValueError for numbers of starts, samples or steps below 1.
    """

    starts: int = 8
    samples: int = 256
    steps: int = 30
    tolerance: float = 1e-4
    tolerance_db: float = MATCHED
    separation: float = SEPARATION

    def __post_init__(self):
        counts = {"starts": self.starts, "samples": self.samples, "steps": self.steps}
        checks.at_least_one(counts)


class Match(Module):
    """Result of `match_response`.

    - `found`: local optima, best first, without repetitions; their `objective` is the misfit, dB.
    - `misfit_db`: the best of them; infinite if there is none.
    - `status`: "matched" within the tolerance, "not_attained", or "non_finite" if no design that
      was looked at has a response.
    - `evaluations`: number of evaluations of the response, with or without its derivatives, samples
      included.
    - `failed`: number of samples and descents that met a response that is not finite.
    """

    found: tuple[Found, ...]
    misfit_db: float
    status: MatchStatus
    evaluations: int
    failed: int


@checked
@watched("matching the response")
def match_response(
    model: ResponseModel, target: Numbers, settings: MatchSettings = MatchSettings(), *, key: Key
) -> Match:
    """The designs of a space whose levels are nearest to target ones.

    **Arguments**

    - `model`: the space, the camera and the rings.
    - `target`: levels in dB, one for each ring from zero frequency up (`ring_levels`), at least 0.

    **Validity.** The response has many local optima; more starts and samples find better ones. A
    target that no design fulfils has the status "not_attained".

    **Errors**: ValueError for target levels that are not finite or below 0.
    """
    key = random_key(key)
    space = model.space
    levels = checked_levels(target, model.rings, space.lower.dtype)
    count = max(settings.samples, settings.starts)
    points, values = sampled(_misfit, space, (model, levels), count, key)
    chosen = best_apart(np.asarray(points), np.asarray(values), settings.starts)
    lengths = settings.steps, settings.tolerance
    ended = _least_squares(model, levels, points[chosen], *lengths)
    search = search_of(space, values, ended, settings.separation)
    best = search.found[0].objective if search.found else np.inf
    status = match_status(best, settings.tolerance_db)
    return Match(search.found, best, status, search.evaluations, search.failed)


def match_status(misfit_db: float, tolerance_db: float) -> MatchStatus:
    """Name of the misfit."""
    if not np.isfinite(misfit_db):
        return "non_finite"
    return "matched" if misfit_db <= tolerance_db else "not_attained"


def _misfit(design: Design, data: Any) -> Float[Array, ""]:
    model, target = data
    known = channels(design, model.setup, model.synthesis, model.frequencies)
    return response_misfit(known, model.frequencies, target)


@functools.partial(jax.jit, static_argnames="steps")
def _least_squares(
    model: ResponseModel,
    target: Float[Array, " ring"],
    points: Float[Array, "start variable"],
    steps: int,
    tolerance,
) -> Descents:
    solver = optimistix.LevenbergMarquardt(rtol=tolerance, atol=tolerance)

    def residual(y, given):
        model, target = given
        return (model.levels(on_cube(y)) - target) * (_WEIGHT / target.shape[0] ** 0.5)

    def one(point):
        solution = optimistix.least_squares(
            residual,
            solver,
            jnp.arcsin(jnp.sqrt(point)),
            args=(model, target),
            max_steps=steps,
            throw=False,
        )
        ended = on_cube(solution.value)
        value = root_mean_square(model.levels(ended) - target)
        converged = solution.result == optimistix.RESULTS.successful
        return Descents(ended, value, solution.stats["num_steps"] + 1, converged)

    # A face is a stationary point of sin²: a start on it would stay.
    return jax.vmap(one)(jnp.clip(points, 1e-3, 1 - 1e-3))
