"""Limits of resolution read off a transfer function.

Eager NumPy functions of a response sampled on ascending frequencies ≥ 0.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Num

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked

Curve = Num[np.ndarray, "..."]

# Frequencies, as a part of the highest, that count as low.
_LOW = 0.05

# The columns of a sensor from which on one is among those: columns/2 − 1 frequencies above zero.
MINIMUM_COLUMNS = round(2 / _LOW) + 2


@checked
def low_frequency_value(frequency: Curve, response: Curve) -> float:
    """Root mean square of the response over the lowest 5 % of the frequencies, without zero.

    The mean, because the response of a finite mask ripples, and that of a phase pair oscillates;
    without zero, where a lensless camera has its bias.
    """
    _check(frequency, response)
    low = (frequency > 0) & (frequency <= _LOW * frequency[-1] * (1 + 1e-9))
    if not low.any():
        raise ValueError(
            f"no frequency in (0, {_LOW * frequency[-1]:g}]: sample the response more finely"
        )
    return float(np.sqrt(np.mean(np.abs(response[low]) ** 2)))


def _check(frequency: np.ndarray, *responses: np.ndarray) -> None:
    """Frequencies ascend from zero or above, and every response has a value at each."""
    shapes = {np.shape(array) for array in (frequency, *responses)}
    if len(shapes) > 1 or np.ndim(frequency) != 1 or not np.size(frequency):
        listed = ", ".join(str(np.shape(array)) for array in (frequency, *responses))
        raise ValueError(f"frequency and response have shapes {listed}; give equal lengths (n,)")
    if not (np.diff(frequency) > 0).all() or frequency[0] < 0:
        raise ValueError("frequency must ascend from zero or above; sort it and drop repeats")


@checked
def cut_off(frequency: Curve, response: Curve, part: float = 0.05) -> float:
    """Frequency above which the response stays under `part` of its low-frequency value.

    Linear interpolation between samples; the highest frequency if it never falls so low.
    """
    magnitude = np.abs(response)
    level = float(checks.fraction("part", part)) * low_frequency_value(frequency, response)
    if not level > 0:
        raise ValueError("the response is zero at low frequencies: it has no cut-off")
    above = np.flatnonzero(magnitude > level)
    last = int(above[-1])
    if last + 1 == len(frequency):
        return float(frequency[-1])
    fall = (magnitude[last] - level) / (magnitude[last] - magnitude[last + 1])
    return float(frequency[last] + fall * (frequency[last + 1] - frequency[last]))


@checked
def zero_crossings(frequency: Curve, response: Curve) -> np.ndarray:
    """All frequencies where a real response changes sign, by linear interpolation."""
    _check(frequency, response)
    before, after = response[:-1], response[1:]
    change = np.flatnonzero((before != 0) & (np.sign(before) != np.sign(after)))
    step = np.diff(frequency)[change]
    return frequency[change] + step * before[change] / (before[change] - after[change])


@checked
def first_common_zero(
    frequency: Curve, responses: Sequence[Curve], depth: float = 0.05
) -> float | None:
    """Lowest frequency that none of the real responses carries; None where there is none.

    For one response it is its first zero crossing. Several captures miss a frequency together only
    if all cross zero within a frequency step of each other and their root sum of squares there is
    under `depth` of its low-frequency value. Either must be followed by a revival to twice that:
    the end of the band is the cut-off and no zero.
    """
    if not len(responses):
        raise ValueError("responses is empty; give at least one")
    _check(frequency, *responses)
    total = np.sqrt(np.sum(np.square(responses), axis=0))
    level = depth * low_frequency_value(frequency, total)
    step = float(np.max(np.diff(frequency)))
    crossings = [zero_crossings(frequency, r) for r in responses]
    for candidate in crossings[0]:
        together = all(c.size and np.min(np.abs(c - candidate)) <= step for c in crossings[1:])
        missing = len(responses) == 1 or np.interp(candidate, frequency, total) <= level
        revived = total[frequency > candidate].max(initial=0.0) > 2 * level
        if together and missing and revived:
            return float(candidate)
    return None
