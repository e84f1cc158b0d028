"""Contrast transfer of a design: against simulated PSFs, and against what noise does to it."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from thincam_jax.design import Setup, SignalNoise, objectives, ranking, shots
from thincam_jax.design.objectives import Channels, ObjectiveData
from thincam_jax.design.ranking import modulation_transfer
from thincam_jax.design.setup import Polar, Quadrant
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.lensless.psf import psf
from thincam_jax.reconstruction import phase_pairs

WAVELENGTH, DISTANCE, OBJECT = 500e-6, 3.0, 100.0
HIGHEST = 18.75  # cycles/rad: 6.25 cycles/mm at 3 mm, where the zones of the mask's edge are 6.4
DESIGN = shots([20.0, 15.0], DISTANCE, (0.0, 1.5 * np.pi), wavelength=WAVELENGTH, width=2.0)


def data(snr_db=30.0, synthesis=None) -> ObjectiveData:
    """A sensor so wide that all the light of a narrow object falls on it."""
    setup = Setup(
        pitch=0.04,
        sensor_width=20.0,
        object_distance=OBJECT,
        object_width=10.0,
        noise=SignalNoise(snr_db),
        pixel_integration=False,
    )
    matrix = jnp.asarray(phase_pairs(2) if synthesis is None else synthesis)
    return ObjectiveData(setup, matrix, Quadrant(jnp.asarray(HIGHEST), 160))


def rings_of(image, pitch):
    """Root mean square over 64 rings of the modulus of an image's transform, mm²."""
    count = 1536
    spectrum = np.abs(np.fft.fft2(image, (count, count))) * pitch**2
    frequency = np.fft.fftfreq(count, pitch) * DISTANCE
    place = (np.hypot(frequency[:, None], frequency) / HIGHEST * 64).astype(int).ravel()
    inside = place < 64
    total = np.bincount(place[inside], (spectrum.ravel() ** 2)[inside], 64)
    return np.sqrt(total / np.bincount(place[inside], minlength=64))


def wide(level):
    """Root mean square over 16 rings: the samples of narrow ones scatter about their fringes."""
    area = 2.0 * np.arange(64) + 1
    sums = (level**2 * area).reshape(16, 4).sum(axis=1)
    return np.sqrt(sums / area.reshape(16, 4).sum(axis=1))


@pytest.mark.thorough
def test_sums_of_captures_against_simulated_point_spread_functions():
    """Transforms of the PSFs of each capture; measured within 3.8 %."""
    pitch = 0.02
    images = [
        np.asarray(
            psf(
                camera,
                wavelength=WAVELENGTH,
                object_distance=OBJECT,
                model="separable",
                pixel_integration=False,
            )
        )
        for camera in DESIGN.cameras(Sensor((288, 288), pitch))
    ]
    found = modulation_transfer(DESIGN, data())
    assert found.sums == (((1,), (2,)), ((3,), (4,)))
    for level, (one, other) in zip(found.channels, (images[:2], images[2:]), strict=True):
        light = (one.sum() + other.sum()) * pitch**2
        expected = rings_of(one - other, pitch) / float(light)
        np.testing.assert_allclose(wide(level), wide(expected), rtol=0.05)
        assert level.max() < 0.1  # of all that light little is fringes
    # A capture by itself shows what does not vary with all its contrast.
    alone = modulation_transfer(DESIGN, data(synthesis=np.eye(4)[[0, 2]]))
    assert np.all((alone.channels[:, 0] > 0.93) & (alone.channels[:, 0] <= 1 + 1e-12))
    assert alone.sums == (((1,), ()), ((3,), ()))


@pytest.mark.thorough
def test_noise_takes_the_contrast_of_the_chain():
    """Nearly all is there without noise; below it, ten times the noise leaves a tenth."""
    levels = [modulation_transfer(DESIGN, data(snr)).chain for snr in (120.0, 30.0, -50.0, -60.0)]
    for more, less in zip(levels, levels[1:], strict=False):
        assert np.all((more > less) & (less > 0) & (more < 1))
    assert levels[0].min() > 0.99
    np.testing.assert_allclose(levels[2] / levels[3], 10, rtol=0.05)
    assert levels[1][3] > levels[1][-1]  # a scene has less at high frequencies


def test_of_even_responses_in_closed_form(monkeypatch):
    """S = 6 ∙ 2 ∙ 2²/8 = 6 everywhere, and fringes of 2 over the light 2 of either capture."""

    def even(design, setup, synthesis, frequencies):
        shape = (len(synthesis), *frequencies.weight.shape)
        full = (jnp.full(shape, value) for value in (2.0, 8.0))
        return Channels(*full, jnp.full(shape[1:], 6.0), frequencies.weight)

    monkeypatch.setattr(objectives, "channels", even)
    monkeypatch.setattr(ranking, "channels", even)
    # Of a size of its own, which is not compiled yet.
    found = modulation_transfer(DESIGN, replace(data(), frequencies=Quadrant(jnp.asarray(9.0), 80)))
    np.testing.assert_allclose(found.chain, 6 / 7)
    np.testing.assert_allclose(found.channels, 2 / 4)
    assert found.channels.shape == (2, 64)


def test_rings_without_the_even_light_are_refused():
    with pytest.raises(TypeError, match="give a Quadrant"):
        polar = Polar(jnp.asarray(HIGHEST), 64, 1)
        modulation_transfer(DESIGN, replace(data(), frequencies=polar))
