"""Sums of separable terms: the image and its transform, against plain sums."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.lensless.propagation.separable import SeparableSum


@pytest.mark.parametrize("shape", [(6, 9), (7, 4), (1, 1), (1, 6), (5, 1)])
def test_image_and_transform(shape):
    """Re ΣYX, and Σ h e^{−2πj(ux+vy)} pitch² at the grid's own coordinates and frequencies."""
    rng = np.random.default_rng(3)
    rows, columns = (rng.normal(size=(2, 3, n)) @ np.eye(n) for n in shape)
    rows, columns = rows[0] + 1j * rows[1], columns[0] + 1j * columns[1]
    grid = tc.Grid(shape, 0.3)
    terms = SeparableSum(jnp.asarray(rows), jnp.asarray(columns), grid)
    value, transform = jax.jit(lambda t: (t.image(), t.transform()))(terms)
    image = sum(np.outer(y, x).real for y, x in zip(rows, columns, strict=True))
    np.testing.assert_allclose(value, image, rtol=0, atol=1e-13)
    y, x = ((np.arange(n) - (n - 1) / 2) * 0.3 for n in shape)
    v, u = (np.fft.fftshift(np.fft.fftfreq(n, 0.3)) for n in shape)
    expected = np.exp(-2j * np.pi * np.outer(v, y)) @ image @ np.exp(-2j * np.pi * np.outer(x, u))
    np.testing.assert_allclose(transform, expected * 0.09, rtol=0, atol=1e-13)
