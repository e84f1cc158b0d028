"""Spectra of scenes and noise: values, scale, and fits to synthetic data."""

import jax.numpy as jnp
import numpy as np
import pytest

from thincam_jax._core.grids import Grid
from thincam_jax.reconstruction.spectra import crop_noise, inner_band, prior_spectrum, scene_power

SHAPE, PITCH = (54, 60), 0.025
GRID = Grid(SHAPE, PITCH)


def test_the_prior_falls_with_the_square_of_the_frequency():
    """Along both axes of a grid that is not square; the corner is one cycle per field."""
    value = np.asarray(prior_spectrum("inverse_square", GRID, (20, 40)))
    assert value.shape == (54, 31)
    for row, column in ((0, 0), (3, 0), (0, 3), (-20, 25)):
        v = np.fft.fftfreq(54, PITCH)[row]
        u = np.fft.rfftfreq(60, PITCH)[column]
        corner = 1 / (40 * PITCH)
        ratio = (v**2 + u**2 + corner**2) / corner**2
        assert value[row, column] == pytest.approx(value[0, 0] / ratio)


@pytest.mark.parametrize("prior", ["flat", "inverse_square"])
def test_the_prior_has_variance_one(prior):
    """The mean over all frequencies, the half that a real DFT leaves out counted too."""
    value = np.asarray(prior_spectrum(prior, GRID, (20, 40)))
    doubled = value.sum() + value[:, 1:-1].sum()
    assert doubled / (54 * 60) == pytest.approx(1.0)


def test_scene_power_is_found_in_noise():
    rng = np.random.default_rng(0)
    expected = rng.uniform(0.0, 1.0, (2, 54, 31)) ** 2
    inner = inner_band(SHAPE, (40, 44))
    signal = 0.37 * expected * rng.exponential(size=expected.shape) + 0.01 * rng.normal(
        size=expected.shape
    )
    found = scene_power(jnp.asarray(signal), jnp.asarray(expected), inner)
    assert float(found) == pytest.approx(0.37, rel=0.08)
    # noise alone: next to nothing, but never negative
    assert 0 < float(scene_power(jnp.asarray(-signal), jnp.asarray(expected), inner)) < 1e-5


def test_inner_band_leaves_both_axes_out():
    inner = inner_band(SHAPE, (27, 20))
    v, u = np.abs(np.fft.fftfreq(54)) * 27, np.fft.rfftfreq(60) * 20  # cycles over the sensor
    np.testing.assert_array_equal(inner, (v[:, None] > 3) & (u > 3))
    assert not inner[:, 0].any() and not inner[0].any() and inner[27, 30]


def test_steps_at_the_border_are_counted_as_noise():
    """What is found on one axis falls off like 1/(1 + f²) from it, f in cycles over the sensor."""
    sensor = (27, 20)
    v, u = np.abs(np.fft.fftfreq(54))[:, None] * 27, np.fft.rfftfreq(60)[None] * 20
    strength = np.random.default_rng(0).uniform(0.5, 1.0, (54, 31))
    on_v = np.where((u <= 1) & (v > 1), strength.mean(axis=1, keepdims=True), 0.0)
    on_u = np.where((v <= 1) & (u > 1), strength.mean(axis=0, keepdims=True), 0.0)
    expected_v = np.where(v > 1, strength.mean(axis=1, keepdims=True), 0.0) / (1 + u**2)
    expected_u = np.where(u > 1, strength.mean(axis=0, keepdims=True), 0.0) / (1 + v**2)
    for periodogram, expected in (
        (on_v, expected_v),
        (on_u, expected_u),
        (on_v + on_u, expected_v + expected_u),
    ):
        noise = crop_noise(jnp.asarray(periodogram)[None], SHAPE, sensor)[0]
        np.testing.assert_allclose(noise, expected, rtol=1e-12)
