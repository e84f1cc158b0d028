"""Cameras that are slightly wrong, by a given error of their PSFs."""

import math
from collections.abc import Callable

import numpy as np
import scipy.optimize

from thincam_jax.bench.cameras import psf_of
from thincam_jax.bench.norms import relative_error
from thincam_jax.config import MethodConfig, StudyConfig
from thincam_jax.study.build import settings

# What is wrong: the mask's curvature β, or its distance d from the sensor.
QUANTITIES = ("beta", "distance")
LEVELS = (0.003, 0.01, 0.03, 0.1)  # relative errors of the PSF
_TOLERANCE = 0.02  # of the level, within which it is met
# Relative changes between which the camera is looked for.
_SMALLEST, _LARGEST = 1e-7, 0.5


def changed(method: MethodConfig, quantity: str, part: float) -> MethodConfig:
    """The method with one quantity of all its shots multiplied by 1 + part."""
    shots = tuple(
        shot.model_copy(update={quantity: getattr(shot, quantity) * (1 + part)})
        for shot in method.shots
    )
    return method.model_copy(update={"shots": shots})


def psfs_of(config: StudyConfig, method: MethodConfig) -> np.ndarray:
    """The exact PSFs (exposure, y, x) of a method on the sensor, in float64."""
    return np.stack([psf_of(config, s) for s in settings(config, method)])


def solve(config: StudyConfig, method: MethodConfig, quantity: str, level: float) -> float | None:
    """The relative change of a quantity that makes the method's PSFs wrong by `level`.

    By bisection in its logarithm (Brent's method), to 2 % of the level. None where no change of up
    to a half does it.
    """
    reference = psfs_of(config, method)

    def excess(logarithm: float) -> float:
        wrong = psfs_of(config, changed(method, quantity, math.exp(logarithm)))
        return math.log(relative_error(wrong, reference) / level)

    bracket = _bracket(excess)
    if bracket is None:
        return None
    # An error of the PSF changes no faster than in proportion to what is wrong.
    root = scipy.optimize.brentq(excess, *bracket, xtol=_TOLERANCE / 2, rtol=1e-12)
    return math.exp(root)


def _bracket(excess: Callable[[float], float]) -> tuple[float, float] | None:
    """Logarithms of a change that is too small and of one that is too large."""
    lower = math.log(_SMALLEST)
    step, end = math.log(10.0), math.log(_LARGEST)
    if excess(lower) > 0:
        return None
    while lower < end:
        upper = min(lower + step, end)
        if excess(upper) > 0:
            return lower, upper
        lower = upper
    return None
