"""Frequencies drawn at random stand for the whole band."""

import numpy as np
import pytest

from thincam_jax.lensless.plan.transfer import centred, image_spectrum, sample_frequencies, waves


@pytest.mark.parametrize("longest", [1, 7, 200, 16384])
def test_weights_are_the_area_of_the_band(longest):
    found = sample_frequencies(longest)
    assert found.weights.sum() == pytest.approx(1.0)
    assert (found.weights > 0).all()
    assert (np.abs(found.v) < 0.5).all() and (found.u >= 0).all() and (found.u < 0.5).all()
    lowest = np.hypot(found.v, found.u).min()
    assert lowest < 0.25 / longest


def test_energy_is_that_of_the_image():
    """Parseval, by sampling: a box's energy lies at low frequencies, a texture's everywhere."""
    random = np.random.default_rng(1)
    box = np.zeros((1, 70, 50))
    box[:, 10:50, 5:40] = 1.0
    texture = random.normal(size=(1, 70, 50))
    estimates = []
    for image in (box, texture):
        ratios = []
        for seed in range(10):
            found = sample_frequencies(70, seed)
            energy = np.sum(found.weights * np.abs(image_spectrum(image, found)) ** 2)
            ratios.append(energy / np.sum(image**2))
        estimates.append(ratios)
    means, spread = np.mean(estimates, axis=1), np.std(estimates, axis=1)
    np.testing.assert_allclose(means, 1.0, atol=0.06)
    assert (spread < 0.2).all()  # of one draw: what the plan's margin of 1.5 must hold


def test_spectrum_is_the_centred_fourier_sum():
    image = np.random.default_rng(2).normal(size=(2, 5, 8))
    found = sample_frequencies(8)
    k = 37
    y, x = np.meshgrid(centred(5), centred(8), indexing="ij")
    phase = np.exp(-2j * np.pi * (found.v[k] * y + found.u[k] * x))
    np.testing.assert_allclose(
        image_spectrum(image, found)[:, k], (image * phase).sum(axis=(1, 2)), rtol=1e-12
    )


def test_waves_are_cosine_and_sine_and_end_with_the_indices():
    frequencies = np.array([0.1, 0.37])
    found = waves(frequencies, centred(5), 8)
    expected = np.exp(-2j * np.pi * np.outer(centred(5), frequencies))
    np.testing.assert_allclose(found[:5, :2] + 1j * found[:5, 2:], expected, rtol=1e-13)
    assert (found[5:] == 0).all()
