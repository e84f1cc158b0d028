"""Masks given by numbers."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.lensless.method import AccuracyWarning

sample = jax.jit(lambda mask, grid: mask.sample(grid))

VALUES = np.array([[1.0, 0.2, 0.5], [0.0, 0.7, 1.0j]])


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


@pytest.mark.parametrize("values", [VALUES, VALUES.T], ids=["wide", "tall"])
def test_gaps_between_cells_pass_their_own_amplitude(values):
    """On samples that are whole parts of a cell and of a gap, of amplitude and irradiance."""
    mask = tc.SampledMask(values, 0.1, fill_factor=0.36, gap=0.25)
    rows, columns = (5 * n - 2 for n in values.shape)  # the rim's gaps are dark
    found = np.asarray(sample(mask, tc.Grid((rows, columns), 0.02)))
    wanted = np.full((rows, columns), 0.25 + 0j)
    for row, column in np.ndindex(values.shape):
        wanted[5 * row :, 5 * column :][:3, :3] = values[row, column]
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    shadow = mask.irradiance()
    grid, pitch = tc.Grid((rows, columns), 0.02), jnp.asarray(0.02)
    down, across = shadow.rows.samples(grid.y, pitch), shadow.columns.samples(grid.x, pitch)
    seen = (np.asarray(shadow.coefficients)[:, None] * np.asarray(down)).T @ np.asarray(across)
    np.testing.assert_allclose(seen, np.abs(wanted) ** 2, atol=1e-12)
    with pytest.raises(ValueError, match="cells that are open all over have no gap"):
        tc.SampledMask(values, 0.1, gap=0.25)


@pytest.mark.parametrize(
    ("lit", "aside", "kept"),
    [((9, 12), 0, (9, 16)), ((9, 12), 9, (9, 32)), ((3, 4), 0, (3, 4)), ((60, 40), 0, (65, 64))],
)
def test_dark_margins_fall_away(lit, aside, kept):
    """The PSF is that of all cells, also of a mask aside and off the axis."""
    values = np.zeros((65, 64))
    top, left = (65 - lit[0]) // 2, (64 - lit[1]) // 2 + aside
    values[top : top + lit[0], left : left + lit[1]] = np.random.default_rng(0).random(lit)
    mask = tc.SampledMask(values, 0.02, centre=(0.0, -0.04), fill_factor=0.8)
    assert mask.without_dark_margins().amplitude.shape == kept
    sensor, point = tc.Sensor((12, 16), 0.05), {"wavelength": 5e-4, "object_distance": 250.0}
    whole = eqx.tree_at(lambda m: m.amplitude, mask, jnp.asarray(values + 1e-300))
    assert whole.without_dark_margins() is whole
    for at in (None, (0.0, 3.0)):
        found, wanted = (
            np.asarray(tc.psf(tc.LenslessCamera(one, sensor, 5.0), **point, at=at))
            for one in (mask, whole)
        )
        np.testing.assert_allclose(found, wanted, atol=1e-9 * wanted.max())


def test_a_small_lens_amid_dark_cells_is_exact():
    """Averages over pixels agree with those over finer ones, without a warning."""
    place = np.arange(140) - 69.5
    square = place[:, None] ** 2 + place**2
    zones = (np.cos(0.1 * square) > 0) & (square < 100)
    camera = tc.LenslessCamera(tc.SampledMask(zones, 0.011), tc.Sensor((24, 20), 0.02), 6.5)
    point = {"wavelength": 5e-4, "object_distance": 250.0}
    with warnings.catch_warnings():
        warnings.simplefilter("error", AccuracyWarning)
        found = np.asarray(tc.psf(camera, **point))
    fine = np.asarray(tc.psf(camera.replace(sensor=tc.Sensor((48, 40), 0.01)), **point))
    assert relative_l2(found, fine.reshape(24, 2, 20, 2).mean((1, 3))) < 1e-6
