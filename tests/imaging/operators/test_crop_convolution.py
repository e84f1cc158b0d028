"""Crop-convolution against direct sums, its adjoint, its gradients; nothing wraps round."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import quick
from thincam_jax._core.grids import Grid
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import kernel_grid, kernel_shape

PITCH = 0.05
# sensor and field with equal, odd-even and even-odd sizes, and the field smaller and larger
SHAPES = [
    ((5, 8), (5, 8)),
    ((6, 9), (3, 4)),
    ((4, 7), (9, 6)),
    ((1, 6), (4, 3)),
    ((1, 1), (2, 5)),
    ((3, 2), (1, 1)),
]


def bump(y, x):
    """A function of the plane without symmetry."""
    return np.exp(-((y - 0.03) ** 2) / 0.02 - (x + 0.07) ** 2 / 0.05) * (1 + 2 * x - 3 * y)


def numbers(shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


def operator(kernel, sensor, field, pitch=PITCH):
    return compiled(jnp.asarray(kernel), pitch, sensor, field)


compiled = eqx.filter_jit(CropConvolution)
seen = eqx.filter_jit(lambda convolution, field: convolution(field))


@pytest.mark.parametrize(("sensor", "field"), quick(SHAPES, 1, 2, 4))
def test_it_is_the_integral_over_the_field(sensor, field):
    """g(r) = Δ² Σ h(r − r′) f(r′), summed with the coordinates of both grids, one by one."""
    f = numbers(field)
    own, other = Grid(sensor, PITCH), Grid(field, PITCH)
    ys, xs, yf, xf = (np.asarray(a) for a in (own.y, own.x, other.y, other.x))
    dy = ys[:, None, None, None] - yf[None, None, :, None]
    dx = xs[None, :, None, None] - xf[None, None, None, :]
    expected = PITCH**2 * np.sum(bump(dy, dx) * f, axis=(2, 3))

    grid = kernel_grid(own, field)
    h = bump(np.asarray(grid.y)[:, None], np.asarray(grid.x))
    value = seen(operator(h, sensor, field), jnp.asarray(f))
    np.testing.assert_allclose(value, expected, rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("corner", [(0, 0), (0, -1), (-1, 0), (-1, -1)])
def test_nothing_wraps_round(corner):
    """A bright pixel in the field's corner, on a sensor as large, with the smallest window."""
    sensor = field = (6, 9)
    kernel = np.zeros(kernel_shape(sensor, field))
    kernel[4:7, 7:10] = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]]  # about the centre 5, 8
    f = np.zeros(field)
    f[corner] = 1.0
    expected = np.zeros((8, 11))
    row, column = np.arange(6)[corner[0]], np.arange(9)[corner[1]]
    expected[row : row + 3, column : column + 3] = kernel[4:7, 7:10]
    value = seen(operator(kernel, sensor, field, pitch=1.0), jnp.asarray(f))
    np.testing.assert_allclose(value, expected[1:-1, 1:-1], atol=1e-14)
