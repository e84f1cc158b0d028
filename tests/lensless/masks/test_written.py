"""Masks as a writer makes them, against a raster that is blurred and cut."""

import numpy as np
import pytest
import scipy.ndimage
import scipy.stats

import thincam_jax as tc
from thincam_jax.lensless.masks.written import as_written
from thincam_jax.units import um

CELL, FINE = 11 * um, 44  # raster points a cell


@pytest.mark.parametrize("bias", [-0.6 * um, 0.0, 0.8 * um])
def test_edges_lie_where_a_blurred_raster_is_cut(bias):
    """Open parts of samples, counted; the cut of b > 0 is lower by what the blur has there."""
    cells = np.random.default_rng(0).random((9, 7)) < 0.5
    cells = np.pad(cells, 1)
    made = as_written(tc.SampledMask(cells * 1.0, CELL), radius=3 * um, bias=bias, samples=4)
    sigma = 3 * um / 1.8612
    blurred = scipy.ndimage.gaussian_filter(
        np.kron(cells, np.ones((FINE, FINE))), sigma * FINE / CELL, truncate=8
    )
    opened = blurred > scipy.stats.norm.cdf(-bias / sigma)
    wanted = opened.reshape(44, FINE // 4, 36, FINE // 4).mean((1, 3))
    assert made.amplitude.shape == wanted.shape and float(made.pitch) == CELL / 4
    difference = np.asarray(made.amplitude) - wanted
    assert np.sqrt(np.mean(difference**2)) < 0.02
    assert abs(difference).max() < 0.25  # where two corners touch


def test_corners_have_the_radius_and_edges_move_by_the_bias():
    cells = np.zeros((7, 7))
    cells[2:6, 2:6] = 1
    radius = 2 * um
    for bias in (-0.4 * um, 0.0, 0.4 * um):
        made = as_written(tc.SampledMask(cells, CELL), radius=radius, bias=bias, samples=55)
        opened = np.asarray(made.amplitude)
        middle = opened[len(opened) // 2]
        assert middle.sum() * CELL / 55 == pytest.approx(4 * CELL + 2 * bias, abs=0.01 * um)
    round_ = np.asarray(
        as_written(tc.SampledMask(cells, CELL), radius=radius, samples=55).amplitude
    )
    lost = (1 - np.diagonal(round_)[110:200]).sum() * CELL / 55 * 2**0.5
    assert lost == pytest.approx((2**0.5 - 1) * radius, rel=0.05)


def test_a_lone_cell_vanishes_where_the_beam_is_wide():
    cells = np.zeros((7, 7))
    cells[3, 3] = 1
    areas = [
        as_written(tc.SampledMask(cells, CELL), radius=n * um).amplitude.sum() / 36
        for n in (1.0, 6.0, 12.0)
    ]
    assert areas[0] == pytest.approx(1 - 4 * (0.77 * 1 / 1.86 / 11) ** 2, abs=0.02)
    assert areas[0] > areas[1] > areas[2] == 0


def test_what_it_refuses():
    with pytest.raises(ValueError, match="cells of 0 and 1 without gaps"):
        as_written(tc.SampledMask([[0.5]], CELL), radius=1 * um)
    with pytest.raises(ValueError, match="cells of 0 and 1 without gaps"):
        as_written(tc.SampledMask([[1.0]], CELL, fill_factor=0.9), radius=1 * um)
    with pytest.raises(ValueError, match="larger radius, a smaller bias or more samples"):
        as_written(tc.SampledMask([[1.0]], CELL), radius=0.1 * um)
