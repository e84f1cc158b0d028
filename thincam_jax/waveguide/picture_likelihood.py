r"""Likelihood of a picture under a model that learns from the picture itself, as in compression.

Pixels are read in rows. Each is predicted from six neighbours that were read before it, with
weights fitted to the pixels around them (edge-directed prediction, Li and Orchard 2001), and its
error has Student's t distribution with the spread of the errors nearby:

.. math:: \log p(F) = \sum_k \log t_\nu\!\left(\frac{F_k - \hat F_k}{s_k}\right) - \log s_k

Every factor is a density given the pixels before, so that the product is a density of the whole
picture: no spectrum or sparsity is assumed, and pictures of other transforms of unit determinant
compare. A repetition within a picture that the neighbours do not explain, such as a ghost, costs
likelihood.
"""

import numpy as np
import scipy
from jaxtyping import Float

_BEFORE = ((0, -1), (-1, 0), (-1, -1), (-1, 1), (0, -2), (-2, 0))  # (y, x) from the pixel
_REACH = 5  # pixels before, in each direction, that the weights are fitted to
_NEARBY = 1  # pixels before, in each direction, whose errors give the spread
_FREEDOM = 4.0  # ν of Student's t
_FLOOR = 0.1  # least variance, of the typical one: no spread is learnt exactly


def picture_likelihood(
    picture: Float[np.ndarray, "y x"], variance: float
) -> Float[np.ndarray, "y x"]:
    """Logarithm of each pixel's density, up to a constant, the mean of two orders of reading.

    - `picture`: picture in any unit. It is read from the top row and from the bottom row.
    - `variance`: variance of the typical error, the picture's unit squared; see `typical_variance`.
    """
    down = _log_density(_errors(picture), variance)
    up = _log_density(_errors(picture[::-1]), variance)
    return (down + up[::-1]) / 2


def typical_variance(picture: Float[np.ndarray, "y x"]) -> float:
    """Variance of a normal distribution with the geometric mean of the squared errors."""
    squared = _errors(picture) ** 2
    least = 1e-12 * max(float(np.mean(picture**2)), np.finfo(float).tiny)
    return 3.56 * float(np.exp(np.mean(np.log(squared + least))))


def _errors(picture: np.ndarray) -> np.ndarray:
    """Errors of the predictions of each pixel from those before it."""
    shape, (rows, columns) = picture.shape, picture.shape
    padded = np.pad(picture, ((2, 0), (2, 2)), mode="edge")
    seen = [padded[2 + y : 2 + y + rows, 2 + x : 2 + x + columns] for y, x in _BEFORE]
    start = (seen[0] + seen[1]) / 2
    details = np.stack([seen[0], *seen[2:]]) - start  # of seen[1] it is that of seen[0], negative
    target, count = picture - start, len(details)
    # Weights for the whole picture first, then what the pixels nearby change them by.
    whole = np.einsum("iyx,jyx->ij", details, details) / picture.size
    whole = whole + 1e-9 * (np.trace(whole) + np.finfo(float).tiny) * np.eye(count)
    mean = np.einsum("iyx,yx->i", details, target) / picture.size
    left = target - np.tensordot(np.linalg.solve(whole, mean), details, 1)
    first, second = np.triu_indices(count)
    products = _sum_before(details[first] * details[second], _REACH)
    nearby = np.empty((*shape, count, count))
    nearby[..., first, second] = nearby[..., second, first] = np.moveaxis(products, 0, -1)
    strength = np.trace(nearby, axis1=-2, axis2=-1) / np.trace(whole) / _count(_REACH)
    nearby += np.maximum(strength, 1e-3)[..., None, None] * whole
    moments = np.moveaxis(_sum_before(details * left, _REACH), 0, -1)
    change = np.linalg.solve(nearby, moments[..., None])[..., 0]
    return left - np.einsum("yxi,iyx->yx", change, details)


def _log_density(errors: np.ndarray, variance: float) -> np.ndarray:
    squared = errors**2
    spread = (_sum_before(squared, _NEARBY) + variance) / (_count(_NEARBY) + 1) + _FLOOR * variance
    tail = np.log1p(squared / (_FREEDOM * spread))
    return -0.5 * np.log(spread) - 0.5 * (_FREEDOM + 1) * tail


def _count(reach: int) -> int:
    """Number of the pixels before one within a reach."""
    return 2 * reach * (reach + 1)


def _sum_before(values: np.ndarray, reach: int) -> np.ndarray:
    """Sum over the pixels before each, within a reach: above and in its row, (*batch, y, x)."""
    wide = (2 * reach + 1) * scipy.ndimage.uniform_filter1d(values, 2 * reach + 1, mode="nearest")
    return _sum_of_last(wide, reach, -2) + _sum_of_last(values, reach, -1)


def _sum_of_last(values: np.ndarray, reach: int, axis: int) -> np.ndarray:
    """Sum of the `reach` entries before each along an axis."""
    values = np.moveaxis(values, axis, -1)
    sums = np.cumsum(np.pad(values, [(0, 0)] * (values.ndim - 1) + [(reach + 1, 0)]), axis=-1)
    size = values.shape[-1]
    return np.moveaxis(sums[..., reach : reach + size] - sums[..., :size], -1, axis)
