"""Rows and columns that stand for all: what they weigh and where they lie."""

import jax.numpy as jnp
import numpy as np
import pytest

from thincam_jax._core.grids import Grid
from thincam_jax.lensless.accuracy.lines import COUNT, SparseGrid, chosen

SEEDS = range(300)


@pytest.mark.parametrize("count", [1, 2, 77, COUNT])
def test_few_are_all_taken_once(count):
    indices, weights = chosen(count, (3.0, 50.0), 5.0, seed=0)
    assert len(indices) == len(weights) == COUNT
    np.testing.assert_array_equal(indices[:count], np.arange(count))
    np.testing.assert_array_equal(weights, np.arange(COUNT) < count)


@pytest.mark.parametrize(
    ("count", "edges", "zone"),
    [
        (COUNT + 1, (20.0, 200.0), 3.0),
        (700, (100.0, 600.0), 20.0),
        (700, (-400.0, 1100.0), 20.0),  # the shadow is larger than the sensor
        (5000, (2400.0, 2600.0), 1.0),
        (3000, (0.0, 2999.0), 1e4),  # all is edge
        (20000, (7000.5, 7900.2), 300.0),
    ],
)
def test_estimates_are_unbiased(count, edges, zone):
    """Sums of a smooth and of a peaked function over all indices, in the mean over seeds.

    The weights of a single choice add up to within a percent; a peak that is as narrow as the
    closely looked-at part around it is off by up to 0.25, measured.
    """
    position = np.arange(count)
    functions = (
        np.ones(count),
        1.5 + np.sin(9 * position / count),
        1 / (1 + ((position - edges[0]) / max(zone, 4.0)) ** 2),
    )
    drawn = [chosen(count, edges, zone, seed) for seed in SEEDS]
    for function, scatter in zip(functions, (0.01, 0.01, 0.3), strict=True):
        sums = np.array([np.sum(weights * function[indices]) for indices, weights in drawn])
        sums /= function.sum()
        assert abs(sums.mean() - 1) < 1e-3 + 3 * sums.std() / np.sqrt(len(SEEDS))
        assert sums.std() < scatter


def test_edges_are_looked_at_closely():
    """60 of 5000 indices are near an edge: half of all that is looked at, none of them twice over.

    Even density would put three there.
    """
    indices, weights = chosen(5000, (1000.0, 4000.0), 15.0, seed=3)
    near = np.minimum(np.abs(indices - 1000), np.abs(indices - 4000)) <= 15
    assert 55 <= len(np.unique(indices[near])) <= 62
    assert weights[near].max() < 1.5 < weights[~near].min()
    far, _ = chosen(5000, (-9000.0, 14000.0), 15.0, seed=3)
    assert np.diff(far).max() < 3 * 5000 / COUNT


def test_a_seed_is_a_choice():
    first, second, other = (chosen(900, (9.0, 80.0), 5.0, seed)[0] for seed in (4, 4, 5))
    np.testing.assert_array_equal(first, second)
    assert (first != other).any()


@pytest.mark.parametrize("factor", [1, 3, 5])
def test_points_are_those_of_the_grid(factor):
    """Coordinates, and the samples that a pixel is divided into: those of the finer grid."""
    grid = Grid((40, 9), jnp.asarray(0.02))
    indices = [np.array([0, 7, 39]), np.array([8, 2])]
    centred = [i - (n - 1) / 2 for i, n in zip(indices, grid.shape, strict=True)]
    points = SparseGrid(*centred, grid.pitch)
    assert points.shape == (3, 2)
    np.testing.assert_allclose(points.y, grid.y[indices[0]], rtol=1e-14)
    np.testing.assert_allclose(points.x, grid.x[indices[1]], rtol=1e-14)
    fine, refined = Grid((40 * factor, 9 * factor), grid.pitch / factor), points.refined(factor)
    np.testing.assert_allclose(
        np.reshape(refined.y, (3, factor)), np.reshape(fine.y, (40, factor))[indices[0]], atol=1e-14
    )
    np.testing.assert_allclose(
        np.reshape(refined.x, (2, factor)), np.reshape(fine.x, (9, factor))[indices[1]], atol=1e-14
    )
