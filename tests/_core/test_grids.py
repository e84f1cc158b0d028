"""Coordinates and frequencies of grids, padding and cropping, with sizes odd, even and one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thincam_jax._core.grids import (
    Grid,
    block_mean,
    block_sum,
    central_blocks,
    fast_shape,
    same_parity,
)

SHAPES = [(1, 1), (1, 6), (5, 1), (4, 7)]


def test_samples_lie_about_the_axis():
    grid = Grid((2, 3), 0.5)
    np.testing.assert_array_equal(grid.y, [-0.25, 0.25])
    np.testing.assert_array_equal(grid.x, [-0.5, 0.0, 0.5])
    assert grid.with_shape((3, 2)).y[0] == -0.5


@pytest.mark.parametrize("shape", SHAPES)
def test_frequencies_are_the_centred_dft(shape):
    grid = Grid(shape, 0.02)
    np.testing.assert_allclose(grid.v, np.fft.fftshift(np.fft.fftfreq(shape[0], 0.02)), atol=1e-12)
    np.testing.assert_allclose(grid.u, np.fft.fftshift(np.fft.fftfreq(shape[1], 0.02)), atol=1e-12)


def test_coordinates_keep_the_precision_of_the_pitch():
    """Whole and half numbers times the pitch: no rounding but the last, in single precision too."""
    grid = Grid((1024, 1023), jnp.float32(5.5e-3))
    assert grid.y.dtype == grid.u.dtype == jnp.float32
    np.testing.assert_array_equal(grid.y, np.float32(5.5e-3) * np.float32(np.arange(1024) - 511.5))
    assert grid.x[511] == 0.0


def test_pitch_is_differentiable():
    slope = jax.grad(lambda p: Grid((3, 4), p).x[3] + 10.0 * Grid((3, 4), p).y[0])(jnp.asarray(0.1))
    assert slope == 1.5 - 10.0


@pytest.mark.parametrize(
    ("shape", "sensor", "expected"),
    [((40, 46), (96, 85), (40, 47)), ((41, 47), (96, 85), (42, 47)), ((1, 1), (1, 1), (1, 1))],
)
def test_same_parity(shape, sensor, expected):
    assert same_parity(shape, sensor) == expected


def test_fast_shape_holds_the_shape():
    assert fast_shape((1023, 2)) == (1024, 2)
    assert fast_shape((1874, 7), real=True) == (1875, 8)


class TestBlocks:
    @pytest.mark.parametrize("of", [np.asarray, jnp.asarray])
    def test_sums_and_means_block_by_block(self, of):
        image = np.random.default_rng(7).normal(size=(2, 6, 9))
        expected = np.zeros((2, 2, 3))
        for c, y, x in np.ndindex(expected.shape):
            expected[c, y, x] = image[c, 3 * y : 3 * y + 3, 3 * x : 3 * x + 3].sum()
        np.testing.assert_allclose(block_sum(of(image), 3), expected, rtol=1e-13, atol=1e-14)
        np.testing.assert_allclose(block_mean(of(image), 3), expected / 9, rtol=1e-13, atol=1e-14)
        np.testing.assert_array_equal(
            block_sum(of(image > 0), 3)[0, 0, 0], (image > 0)[0, :3, :3].sum()
        )

    def test_in_double_precision_nothing_is_lost_to_summation(self):
        image = np.full((1, 512, 1024), 0.1, np.float32)
        image[..., ::2] = 1e-4
        exact = np.mean([np.float64(np.float32(0.1)), np.float64(np.float32(1e-4))]) * 512**2
        np.testing.assert_allclose(block_sum(image, 512, np.float64), exact, rtol=1e-12)

    def test_the_crop_is_central(self):
        assert central_blocks((12, 15), 4) == (slice(0, 12), slice(1, 13))
        assert central_blocks((11, 7), 4) == (slice(1, 9), slice(1, 5))
        assert central_blocks((11, 7), 1) == (slice(0, 11), slice(0, 7))
