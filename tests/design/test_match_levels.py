"""Levels of a response, and the misfit of two."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from design.setting import setup, thesis_design, two_betas

from helpers import finite_difference
from thincam_jax.design import PowerLaw
from thincam_jax.design.match import ResponseModel, checked_levels, response_misfit, ring_levels
from thincam_jax.design.objectives import channels
from thincam_jax.design.setup import Polar
from thincam_jax.reconstruction import phase_pairs

FREQUENCIES = Polar(96.0, 128, 2)
DATA = (setup(prior=PowerLaw(2.8)), jnp.asarray(phase_pairs(2)), FREQUENCIES)
POINT = (0.6, 0.3)


@pytest.fixture(scope="module")
def known():
    return jax.jit(lambda design: channels(design, *DATA))(thesis_design())


@pytest.fixture(scope="module")
def model():
    return ResponseModel(two_betas(), *DATA, 16)


def test_levels_are_means_over_rings(known):
    """Against sums by hand; above the noise the ratio in dB, in it 0."""
    levels = ring_levels(known, FREQUENCIES, 16)
    ratio, weight = np.asarray(known.signal_to_noise), np.asarray(known.weight)
    for ring in (0, 5, 15):
        inside = slice(8 * ring, 8 * ring + 8)
        mean = np.sum((ratio * weight)[:, inside]) / np.sum(weight[:, inside])
        np.testing.assert_allclose(levels[ring], 10 * np.log10(1 + mean), rtol=1e-12)
    loud = replace(known, response=1e3 * known.response)
    gained = ring_levels(loud, FREQUENCIES, 16) - levels
    np.testing.assert_allclose(gained[:2], 60.0, atol=0.2)
    quiet = replace(known, response=1e-6 * known.response)
    assert np.all(ring_levels(quiet, FREQUENCIES, 16) < 1e-3)


def test_misfit_is_the_root_mean_square(known):
    levels = ring_levels(known, FREQUENCIES, 16)
    np.testing.assert_allclose(response_misfit(known, FREQUENCIES, levels + 3.0), 3.0, rtol=1e-12)
    apart = levels.at[3].add(4.0)
    np.testing.assert_allclose(response_misfit(known, FREQUENCIES, apart), 1.0, rtol=1e-12)
    assert response_misfit(known, FREQUENCIES, levels) < 1e-12


@pytest.mark.thorough
def test_slopes(model):
    """Against differences of fourth order, and a number where the misfit is 0."""
    point = jnp.asarray(POINT)
    target = model.levels(point) + jnp.linspace(-1.0, 3.0, 16)
    value = jax.jit(lambda p, w: model.misfit(p, w))
    slope = jax.jit(jax.grad(model.misfit))
    for direction in np.eye(2):
        expected = finite_difference(lambda p: value(p, target), point, direction, 2e-6)
        np.testing.assert_allclose(slope(point, target) @ direction, expected, rtol=1e-5)
    assert np.all(np.isfinite(slope(point, model.levels(point))))


def test_traced_levels_pass():
    levels = jax.jit(lambda w: checked_levels(w, 2, jnp.float64))(jnp.array([1.0, -1.0]))
    np.testing.assert_array_equal(levels, [1.0, -1.0])
