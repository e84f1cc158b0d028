"""A sum of convolutions against the direct sum over a PSF that changes over the field."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import relative_l2
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.base import adjoint_error
from thincam_jax.imaging.operators.low_rank import low_rank_psf
from thincam_jax.reconstruction.scaled_problem import MARGIN

SENSOR, FIELD, KERNEL, PITCH = (21, 26), (17, 22), (11, 13), 0.5


def psf(y, x):
    """Of a point at (y, x), each from −1 to 1: a spot that grows and moves, and a ghost."""
    rows, columns = (np.arange(n) - n // 2 for n in KERNEL)
    width = 1.2 + 0.3 * y + 0.2 * x**2
    rows, columns = rows[:, None] - 0.4 * x, columns + 0.5 * y * x
    ghost = (0.3 + 0.1 * x) * np.exp(-((rows - 3) ** 2 + columns**2) / 2)
    return np.exp(-(rows**2 + columns**2) / (2 * width**2)) / width**2 + ghost


def grid(points):
    places = [np.linspace(-1, 1, n) for n in points]
    return np.array([[psf(y, x) for x in places[1]] for y in places[0]])


def direct(image):
    """g = Σ_u f(u) h(x − u; u), point by point."""
    rows, columns = (s + k - 1 for s, k in zip(FIELD, KERNEL, strict=True))
    whole = np.zeros((rows, columns))
    places = [np.linspace(-1, 1, n) for n in FIELD]
    for m, n in np.ndindex(*FIELD):
        spot = PITCH**2 * image[m, n] * psf(places[0][m], places[1][n])
        whole[m : m + KERNEL[0], n : n + KERNEL[1]] += spot
    margins = [(r - s) // 2 for r, s in zip(whole.shape, SENSOR, strict=True)]
    return whole[margins[0] :, margins[1] :][: SENSOR[0], : SENSOR[1]]


def test_direct_sum():
    """The error is what is stated, and falls with tolerance and grid."""
    image = np.random.default_rng(2).uniform(size=FIELD)
    expected, found = direct(image), []
    for tolerance, points in ((0.1, (5, 5)), (1e-2, (9, 11)), (1e-3, (21, 21))):
        fit = low_rank_psf(grid(points), PITCH, SENSOR, FIELD, tolerance=tolerance)
        error = relative_l2(np.asarray(fit.operator(jnp.asarray(image))), expected)
        assert fit.truncation_error <= tolerance
        assert error < fit.truncation_error + fit.interpolation_error
        assert adjoint_error(fit.operator, jax.random.key(0)) < 1e-13
        found.append((fit.operator.weights.shape[0], error))
    ranks, errors = zip(*found, strict=True)
    assert ranks[0] < ranks[1] < ranks[2] < 20
    assert errors[2] < 1e-3 < errors[0]


def test_measured_positions():
    """A grid that ends before the corners: exact between its points, constant beyond."""
    rows, columns = np.array([2.0, 8.0, 14.5]), np.array([3.0, 10.0, 12.0, 19.0])
    places = (2 * rows / (FIELD[0] - 1) - 1, 2 * columns / (FIELD[1] - 1) - 1)
    psfs = np.array([[psf(y, x) for x in places[1]] for y in places[0]])
    found = low_rank_psf(
        psfs, PITCH, SENSOR, FIELD, tolerance=1e-6, positions=(rows, columns)
    ).operator

    def seen(row, column):
        return np.asarray(found(jnp.zeros(FIELD).at[row, column].set(1.0)))

    for point, (row, column) in (((1, 1), (8, 10)), ((0, 3), (0, 21)), ((1, 2), (8, 12))):
        whole = np.zeros((FIELD[0] + KERNEL[0] - 1, FIELD[1] + KERNEL[1] - 1))
        whole[row : row + KERNEL[0], column : column + KERNEL[1]] = PITCH**2 * psfs[point]
        top, left = ((w - s) // 2 for w, s in zip(whole.shape, SENSOR, strict=True))
        whole = whole[top:, left:][: SENSOR[0], : SENSOR[1]]
        np.testing.assert_allclose(seen(row, column), whole, atol=1e-9)
    with pytest.raises(ValueError, match="give 3 rows and 4 columns of the field, increasing"):
        low_rank_psf(psfs, PITCH, SENSOR, FIELD, tolerance=0.1, positions=(columns, rows))
    with pytest.raises(ValueError, match=r"field_shape = \(1, 9\) has one line .* give 2×2"):
        low_rank_psf(psfs, PITCH, SENSOR, (1, 9), tolerance=0.1)


def test_even_psfs_are_centred_on_their_middle_pixel():
    psfs = grid((5, 5))
    shorter = psfs[..., :-1, :-1].copy()
    psfs[..., -1, :] = psfs[..., :, -1] = 0
    odd, even = (
        low_rank_psf(p, PITCH, SENSOR, FIELD, tolerance=0.01).operator for p in (psfs, shorter)
    )
    image = jax.random.uniform(jax.random.key(5), FIELD)
    np.testing.assert_allclose(even(image), odd(image), atol=1e-12)


def test_mean_power_and_norm():
    """One PSF everywhere has the mean power of its convolution; the norm is within its margin."""
    one = np.broadcast_to(np.random.default_rng(2).uniform(size=(7, 9)), (3, 3, 7, 9))
    alike = low_rank_psf(one, PITCH, SENSOR, FIELD, tolerance=0.1).operator
    convolution = CropConvolution(jnp.asarray(one[0, 0]), PITCH, SENSOR, FIELD)
    assert alike.mean_power() == pytest.approx(float(convolution.mean_power()), rel=1e-12)
    operator = low_rank_psf(grid((3, 3)), PITCH, SENSOR, FIELD, tolerance=1e-3).operator
    unit = jnp.eye(operator.weights[0].size).reshape(-1, *operator.in_shape)
    largest = np.linalg.norm(np.asarray(operator(unit)).reshape(len(unit), -1), 2)
    assert largest / MARGIN < operator.norm() < largest * (1 + 1e-12)
