"""Values of an image that measure no light: a plateau where it is cut off, defective pixels."""

import functools

import numpy as np
import scipy
from jaxtyping import Bool, Float, Shaped

_FEW = 20  # pixels at one value that a clean image may have
_STEEP = 3.0  # times as many pixels as at each of the values below
_ISOLATED = 3.0  # times the range of the neighbours, by which a defective pixel exceeds them
_CERTAIN = 8.0  # standard deviations of the noise, or counts
_SPREAD = 0.1  # share of a point of light that its neighbours have at least
_OUTER = np.flatnonzero(np.pad(np.zeros((3, 3)), 1, constant_values=1))  # of 5×5 pixels
RING = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], bool)


def plateau(pixels: Shaped[np.ndarray, "*shape"]) -> int:
    """Count the pixels at the largest value where more than noise puts there, else 0."""
    below = pixels[pixels < pixels.max()]
    count = pixels.size - below.size
    if count < _FEW or below.size < _FEW:
        return 0
    kept = min(below.size, below.size // 8 + 1000)
    _, counts = np.unique(np.partition(below, -kept)[-kept:], return_counts=True)
    return count if counts.size >= 16 and count > _STEEP * counts[-8:].max() else 0


def defects(plane: Float[np.ndarray, "y x"], step: float = 0.0) -> Bool[np.ndarray, "y x"]:
    """Map of single pixels of one colour that differ from all neighbours as no light does.

    - `step`: step between values, 1 for counts.
    """
    if min(plane.shape) < 8:
        return np.zeros(plane.shape, bool)
    # Without scipy's filters, whose import takes longer than a whole check, where nothing is found.
    padded, (rows, columns) = np.pad(plane, 1, mode="reflect"), plane.shape
    beside = [padded[y : y + rows, x : x + columns] for y, x in np.argwhere(RING)]
    high, low = (functools.reduce(one, beside) for one in (np.maximum, np.minimum))
    beyond = np.maximum(plane - high, low - plane)
    middle, top = np.percentile(plane, [50, 99.5])
    floor = max(_CERTAIN * max(fine_noise(plane), step), 0.01 * (top - middle))
    odd = beyond > np.maximum(_ISOLATED * (high - low), floor)
    rows, columns = np.nonzero(odd)
    if not 0 < rows.size <= max(_FEW, odd.size // 100):
        return np.zeros_like(odd)
    # Light of a point reaches the neighbours; a defect does not raise them above what is around.
    padded = np.pad(plane, 2, mode="reflect")
    squares = np.lib.stride_tricks.sliding_window_view(padded, (5, 5))[rows, columns]
    cross = squares[:, [1, 2, 2, 3], [2, 1, 3, 2]].mean(axis=1)
    outer = np.median(squares.reshape(-1, 25)[:, _OUTER], axis=1)
    sign = np.sign(plane[rows, columns] - cross)
    odd[rows, columns] = sign * (cross - outer) <= _SPREAD * beyond[rows, columns]
    # A mask as fine as a pixel, or points that are all the light there is, are no defects.
    around = scipy.ndimage.binary_dilation(odd, np.ones((5, 5), bool))
    base = scipy.ndimage.minimum_filter(plane, 5, mode="mirror")
    mean = (9 * scipy.ndimage.uniform_filter(plane, 3, mode="mirror") - plane) / 8
    sharp = (plane - base > floor) & (mean - base < 0.25 * (plane - base)) & ~around
    light = np.maximum(np.abs(plane - middle) - floor / 2, 0)
    is_structure = 2 * sharp.sum() > odd.sum() or light[odd].sum() > 0.3 * light.sum()
    return odd & ~is_structure


def fine_noise(plane: np.ndarray) -> float:
    """Standard deviation of noise, by the median of second differences along rows."""
    bend = plane[:, 1:-1] - (plane[:, 2:] + plane[:, :-2]) / 2
    return 1.21 * float(np.median(np.abs(bend)))
