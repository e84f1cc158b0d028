"""Cameras that are slightly wrong, by a given error of their PSFs."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import scipy.optimize

from thincam_jax.commands.accuracy.cameras import psf_of
from thincam_jax.commands.accuracy.norms import relative_error
from thincam_jax.commands.study.study import Method, Study

# What is wrong: the mask's curvature β, or its distance d from the sensor.
QUANTITIES = ("beta", "distance")
LEVELS = (0.003, 0.01, 0.03, 0.1)  # relative errors of the PSF
_TOLERANCE = 0.01  # of the level, within which it is met
# The largest relative change that is looked at, and the one to begin with.
_LARGEST, _FIRST = 0.5, 1e-5
# Relative changes come in these steps: distances of few digits then keep their ratio to the last
# bit in float32, and no reconstruction is compiled anew.
_STEP = 2.0**-20


def changed(method: Method, quantity: str, part: float) -> Method:
    """The method with one quantity of all its exposures multiplied by 1 + part."""
    exposures = tuple(
        exposure._replace(**{quantity: getattr(exposure, quantity) * (1 + part)})
        for exposure in method.exposures
    )
    return dataclasses.replace(method, exposures=exposures)


def psfs_of(study: Study, method: Method) -> np.ndarray:
    """The exact PSFs (exposure, y, x) of a method on the sensor, in float64."""
    return np.stack([psf_of(study, exposure) for exposure in method.exposures])


def solve(study: Study, method: Method, quantity: str, level: float) -> float | None:
    """The relative change of a quantity that makes the method's PSFs wrong by `level`.

    By a bracketed search in its logarithm (Brent's), to 1 % of the level. None where no change of
    up to a half does it.
    """
    reference = psfs_of(study, method)

    def excess(logarithm: float) -> float:
        wrong = psfs_of(study, changed(method, quantity, math.exp(logarithm)))
        return math.log(relative_error(wrong, reference) / level)

    bracket = _bracket(excess)
    if bracket is None:
        return None
    found = scipy.optimize.root_scalar(
        excess, bracket=bracket, method="brentq", xtol=_TOLERANCE / 2, rtol=1e-9
    )
    return max(1, round(math.exp(found.root) / _STEP)) * _STEP


def _bracket(excess: Callable[[float], float]) -> tuple[float, float] | None:
    """Logarithms of a change that is too small and of one that is too large."""
    guess, end = math.log(_FIRST), math.log(_LARGEST)
    # Small errors grow in proportion to what is wrong.
    guess = min(guess - excess(guess), end)
    step = math.log(1.3) if excess(guess) < 0 else -math.log(1.3)
    last = guess
    while last < end or step < 0:
        following = min(last + step, end)
        if (excess(following) < 0) != (step > 0):
            return min(last, following), max(last, following)
        last, step = following, 2 * step
        if step < -100:
            break
    return None
