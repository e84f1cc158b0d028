"""Light and variance of captures, against captures of random scenes."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.design import PhotonNoise, Polar, PowerLaw, Setup, SignalNoise
from thincam_jax.design.design import Design
from thincam_jax.design.response import capture_light, responses, signal_variance, spectral_density
from thincam_jax.design.setup import Quadrant
from thincam_jax.lensless.exposures import Exposures

respond = jax.jit(responses)
PITCH, DISTANCE, FAR, CELLS = 0.03, 5.0, 100.0, 240
CELL = PITCH * FAR / DISTANCE  # of the object, that a pixel sees


def small(width=CELL * CELLS, exponent=1.5):
    """64×64 pixels, a mask of 2 mm, an object that fills the view of every pixel."""
    design = Design(Exposures([40.0], DISTANCE, phase=1.0, wavelength=500e-6, width=2.0))
    judged = Setup(
        pitch=PITCH,
        sensor_width=64 * PITCH,
        object_distance=FAR,
        object_width=width,
        prior=PowerLaw(exponent, 6.0),
        contrast=0.3,
    )
    return design, judged


def scenes(judged, count=96):
    """Random ones with the spectrum up to the sensor's Nyquist frequency."""
    nu = np.fft.fftfreq(CELLS, PITCH / DISTANCE)
    density = judged.prior(jnp.asarray(nu[:, None] ** 2 + nu**2), judged.field)
    filters = np.sqrt(density / np.mean(density)) * 0.3
    white = np.random.default_rng(4).normal(size=(count, CELLS, CELLS))
    return 1 + np.fft.ifft2(np.fft.fft2(white) * filters).real


@pytest.fixture(scope="module")
def captured():
    design, judged = small()
    camera = design.cameras(tc.Sensor((64, 64), PITCH))[0]
    drawn = jnp.asarray(scenes(judged))  # zero on average: a capture is linear in them
    plane = tc.ImagePlane(jnp.ones_like(drawn), FAR, CELL * CELLS)
    plane = eqx.tree_at(lambda plane: plane.image, plane, drawn)
    return np.asarray(tc.capture(camera, tc.Scene(plane, 500e-6)))


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["quadrant", "polar"])
def test_variance_of_random_scenes(captured, kind):
    """96 captures: their mean is known to 7 %. Agreement: 1 % (exact model), 11 % (rings)."""
    design, judged = small()
    highest = DISTANCE / PITCH / 2
    frequencies = Quadrant(highest, 200) if kind == "quadrant" else Polar(highest, 800, 4)
    whole = respond(design, judged, frequencies).whole
    density = spectral_density(judged, frequencies)
    value = float(jax.jit(signal_variance)(design, judged, frequencies, whole, density)[0])
    variances = np.var(captured, axis=(-2, -1))
    known_to = np.std(variances) / np.sqrt(len(variances)) / np.mean(variances)
    assert known_to < 0.08
    np.testing.assert_allclose(value, np.mean(variances), rtol=0.05 if kind == "quadrant" else 0.2)


@pytest.mark.thorough
def test_light_of_an_even_scene(captured):
    """Every pixel sees all of the mask: to 2 %, what the fringes add or take."""
    design, judged = small()
    value = float(capture_light(design, judged)[0])
    np.testing.assert_allclose(np.mean(captured), value, rtol=0.03)


def test_light_of_a_small_object():
    """Coarse: the middle of the sensor sees all of the object, its rim less (measured 0.8)."""
    design, judged = small(width=20.0)
    camera = design.cameras(tc.Sensor((64, 64), PITCH))[0]
    plane = tc.ImagePlane(np.ones((40, 40)), FAR, 20.0)
    image = np.asarray(tc.capture(camera, tc.Scene(plane, 500e-6)))
    value = float(capture_light(design, judged)[0])
    np.testing.assert_allclose(np.mean(image[24:40, 24:40]), value, rtol=0.2)
    assert 0.5 < np.mean(image) / value < 1.1


def test_density_has_the_contrast():
    for frequencies in (Quadrant(80.0, 50), Polar(80.0, 60, 2)):
        density = spectral_density(small()[1], frequencies)
        np.testing.assert_allclose(jnp.sum(density * frequencies.weight), 0.09, rtol=1e-12)


def test_noise():
    light, signal, exposure = jnp.asarray([2.0, 3.0]), jnp.asarray([0.5, 0.1]), jnp.asarray(0.25)
    np.testing.assert_allclose(SignalNoise(20.0).variance(light, signal, exposure), signal / 100)
    counted = PhotonNoise(1000.0, 5.0).variance(light, signal, exposure)
    np.testing.assert_allclose(counted, [(500 + 25) / 250**2, (750 + 25) / 250**2])


@pytest.mark.thorough
def test_a_wide_sensor_counts_all_variance():
    """The window takes away what varies over more than the sensor: nothing if it is endless."""
    design, judged = small()
    wide = dataclasses.replace(judged, sensor_width=jnp.asarray(1e4))
    frequencies = Quadrant(83.0, 64)
    whole = respond(design, judged, frequencies).whole
    everything = jnp.sum(
        whole**2 * spectral_density(judged, frequencies) * frequencies.weight, axis=(1, 2)
    )
    # The zero frequency alone is the mean.
    density = spectral_density(judged, frequencies)
    mean = (whole**2 * density * frequencies.weight)[:, 0, 0]
    known = spectral_density(wide, frequencies)
    value = jax.jit(signal_variance)(design, wide, frequencies, whole, known)
    np.testing.assert_allclose(value, everything - mean, rtol=1e-3)
    seen = signal_variance(design, judged, frequencies, whole, density)
    assert float(seen[0]) < 0.9 * float(value[0])
