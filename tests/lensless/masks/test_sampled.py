"""Masks given by numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc

sample = jax.jit(lambda mask, grid: mask.sample(grid))

VALUES = np.array([[1.0, 0.2, 0.5], [0.0, 0.7, 1.0j]])


def test_its_own_grid_gives_it_back():
    mask = tc.SampledMask(VALUES, 0.1)
    np.testing.assert_allclose(sample(mask, tc.Grid((2, 3), 0.1)), VALUES, atol=1e-14)
    wide = sample(mask, tc.Grid((4, 5), 0.1))
    np.testing.assert_allclose(wide, np.pad(VALUES, 1), atol=1e-14)


def test_centre_moves_it_down_and_right():
    mask = tc.SampledMask(VALUES, 0.1, centre=(0.1, -0.1))
    moved = np.asarray(sample(mask, tc.Grid((4, 5), 0.1)))
    expected = np.roll(np.pad(VALUES, 1), (1, -1), axis=(0, 1))
    np.testing.assert_allclose(moved, expected, atol=1e-14)


def test_samples_average_their_area():
    """Half a cell off, each sample is the mean of its neighbours; the sum is kept."""
    mask = tc.SampledMask(VALUES, 0.1)
    between = np.asarray(sample(mask, tc.Grid((3, 4), 0.1)))
    padded = np.pad(VALUES, 1)
    mean = (padded[1:, 1:] + padded[:-1, 1:] + padded[1:, :-1] + padded[:-1, :-1]) / 4
    np.testing.assert_allclose(between, mean, atol=1e-14)
    fine = np.asarray(sample(mask, tc.Grid((22, 31), 0.013)))
    np.testing.assert_allclose(fine.sum() * 0.013**2, VALUES.sum() * 0.01, rtol=1e-12)


def test_extent_is_height_and_width():
    height, width = tc.SampledMask(VALUES, 0.1).extent
    np.testing.assert_allclose([height, width], [0.2, 0.3])


@pytest.mark.parametrize("shape", [(3,), (0, 4), (2, 3, 1)])
def test_refuses_what_is_no_image(shape):
    with pytest.raises(
        ValueError, match=r"amplitude has shape .*; give a non-empty array \(y, x\)"
    ):
        tc.SampledMask(np.ones(shape), 0.1)


def test_whole_numbers_become_real():
    assert tc.SampledMask(np.eye(3, dtype=int), 0.1).amplitude.dtype == jnp.float64
    with pytest.raises(ValueError, match="pitch = 0.0 mm is not positive"):
        tc.SampledMask(VALUES, 0.0)
