r"""The design whose response is nearest to a target response, by least squares from many starts.

.. math:: \min_p \frac1R \sum_{r=1}^R [L_r(p) - L_r^{target}]^2

over the unit cube of a space, by Levenberg and Marquardt's method: the misfit is a sum of squares,
and R levels say more of where to go than their sum.
"""

import functools
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax._core import checks
from thincam_jax._core.checks import Numbers
from thincam_jax._core.module import Module
from thincam_jax.design.design import Design
from thincam_jax.design.frequencies import Frequencies
from thincam_jax.design.objectives import channels
from thincam_jax.design.search import (
    APART,
    Descents,
    Found,
    best_apart,
    evaluate,
    even_samples,
    on_cube,
    ranked,
)
from thincam_jax.design.setup import Setup
from thincam_jax.design.space import DesignSpace
from thincam_jax.design.target_response import (
    ResponseModel,
    checked_levels,
    response_misfit,
    root_mean_square,
)

MatchStatus = Literal["matched", "not_attained", "non_finite"]
# Misfits up to here count as matched, dB.
MATCHED = 1.0
# Levenberg and Marquardt's damping begins at 1: of residuals in hundredths of a dB that is weak.
_WEIGHT = 100.0


class Match(Module):
    """What `match_response` found.

    - `found`: local optima, best first, without repetitions; their `objective` is the misfit, dB.
    - `misfit_db`: the best of them; infinite if there is none.
    - `status`: "matched" within the tolerance, "not_attained", or "non_finite" if no design that
      was looked at has a response.
    - `evaluations`: of the response, with or without its derivatives, samples included.
    - `failed`: how many samples and descents met a response that is not finite.
    """

    found: tuple[Found, ...]
    misfit_db: float
    status: MatchStatus
    evaluations: int
    failed: int


def match_response(
    space: DesignSpace,
    target: Numbers,
    setup: Setup,
    synthesis: Float[Array, "channel capture"] | Float[np.ndarray, "channel capture"],
    frequencies: Frequencies,
    *,
    key: PRNGKeyArray,
    starts: int = 8,
    samples: int = 256,
    steps: int = 30,
    tolerance: float = 1e-4,
    tolerance_db: float = MATCHED,
    apart: float = APART,
) -> Match:
    """The designs of a space whose levels are nearest to target ones.

    **Arguments**

    - `target`: levels in dB, one for each ring from zero frequency up (`ring_levels`), at least 0.
    - `setup`, `synthesis`, `frequencies`: as of `channels`.
    - `starts`: descents (optimistix' Levenberg-Marquardt under the smooth map sin² onto the cube);
      `samples`: of the even sampling before, from the best of which they start.
    - `steps`: at most, of each descent; it ends where a step changes the misfit by less than
      `tolerance` of itself.
    - `tolerance_db`: misfits up to here are "matched".
    - `apart`: optima closer than this in the cube are one.

    **Validity.** The response has many local optima; more starts and samples find better ones. A
    target that no design fulfils is told by the status "not_attained".

    **Errors**: ValueError for target levels that are not finite or below 0, and for numbers of
    starts, samples or steps below 1.
    """
    checks.at_least_one({"starts": starts, "samples": samples, "steps": steps})
    dtype = space.lower.dtype
    levels = checked_levels(target, np.size(target), dtype)
    model = ResponseModel(space, setup, synthesis, frequencies, len(levels))
    points = even_samples(space.size, max(samples, starts), key, dtype)
    values = evaluate(_misfit, space, (model, levels), points)
    chosen = best_apart(np.asarray(points), np.asarray(values), starts)
    ended = jax.device_get(_least_squares(model, levels, points[chosen], steps, tolerance))
    failed = sum(int(np.sum(~np.isfinite(v))) for v in (np.asarray(values), ended.values))
    found = ranked(space, ended, apart)
    best = found[0].objective if found else np.inf
    used = len(points) + int(np.sum(ended.evaluations))
    return Match(found, best, match_status(best, tolerance_db), used, failed)


def match_status(misfit_db: float, tolerance_db: float) -> MatchStatus:
    """What a misfit is called."""
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
