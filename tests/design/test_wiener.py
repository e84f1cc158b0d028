"""The Wiener objective against the package's Wiener synthesis and against differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import count_traces
from thincam_jax.design import PhotonNoise, PowerLaw, Setup, SignalNoise
from thincam_jax.design.design import Design
from thincam_jax.design.training import TrainedSensor, Training, channels_of
from thincam_jax.design.wiener import restore_by_wiener, wiener_error
from thincam_jax.lensless.exposures import Exposures
from thincam_jax.reconstruction.synthesis import phase_pairs

SENSOR, PITCH = (80, 96), 0.02
PAIR = (0.0, 1.5 * np.pi)
OBJECT, DISTANCE = 100.0, 7.0
# Its pixels are those of the sensor at 7 mm.
COUNT = 70
WIDTH = COUNT * PITCH * OBJECT / DISTANCE


def setup(noise=None, pitch=PITCH):
    return Setup(
        pitch=pitch,
        sensor_width=PITCH * max(SENSOR),
        object_distance=OBJECT,
        object_width=WIDTH,
        noise=noise or SignalNoise(30.0),
        prior=PowerLaw(2.5),
    )


def pictures(count):
    rng = np.random.default_rng(7)
    rough = rng.normal(size=(2, count, count)).cumsum(1).cumsum(2)
    return 1 + 0.5 * rough / np.abs(rough).max(axis=(1, 2), keepdims=True)


def training(noise=None, *, count=COUNT, sensor=SENSOR, synthesis=None, pitch=PITCH):
    return Training(
        pictures(count),
        setup(noise, pitch),
        phase_pairs(2) if synthesis is None else synthesis,
        TrainedSensor(sensor, (5.0, DISTANCE)),
        key=jax.random.key(5),
    )


def design(beta=(19.0, 23.0), distance=(7.0, 7.0), wavelength=5e-4, width=1.71):
    pairs = [jnp.repeat(jnp.asarray(x), 2) for x in (beta, distance)]
    return Design(
        Exposures(
            pairs[0], pairs[1], phase=jnp.asarray(PAIR * 2), wavelength=wavelength, width=width
        )
    )


@count_traces
def restored_and_error(chosen, given):
    return restore_by_wiener(chosen, given), wiener_error(chosen, given)


compiled = eqx.filter_jit(restored_and_error)


@eqx.filter_jit
def captured(chosen, given):
    """Captures and variances of each image: one of a pair holds all the noise of the difference."""
    found = []
    for image, drawn in zip(given.images, given.noise, strict=True):
        captures, variances = [], []
        for channel, noise in zip(channels_of(chosen, given), drawn, strict=True):
            projected = channel._projected(image)
            first, second = (one(projected) for one in channel.captures)
            variance = channel.capture(image, noise)[1]
            captures += [first + jnp.sqrt(variance) * noise, second]
            variances += [variance / 2, variance / 2]  # shared out in what is told of it
        found.append((jnp.stack(captures), jnp.stack(variances)))
    return found


def synthesised(chosen, given):
    """By `WienerSynthesis` from the captures of PSFs, with the same noise."""
    sensor = tc.Sensor(SENSOR, PITCH)
    cameras = tc.Cameras(
        chosen.cameras(sensor),
        wavelength=chosen.wavelength,
        object_distance=OBJECT,
        field_shape=(COUNT, COUNT),
    )
    reconstruct = tc.Wiener(synthesis=phase_pairs(2)).prepare(cameras)
    images = [reconstruct(*seen).image for seen in captured(chosen, given)]
    return np.stack([np.asarray(image)[::-1, ::-1] for image in images])


@pytest.mark.thorough
def test_restored_are_those_of_the_wiener_synthesis():
    given, chosen = training(), design()
    restored, error_of_all = compiled(chosen, given)
    found, expected = np.asarray(restored), synthesised(chosen, given)
    images = np.asarray(given.images)
    error = [np.mean((r - images) ** 2) / np.var(images) for r in (found, expected)]
    assert error[1] < 0.3  # the captures tell something
    assert error[0] == pytest.approx(error[1], rel=0.1)
    assert np.mean((found - expected) ** 2) < 0.1 * np.mean((expected - images) ** 2)
    variance = np.var(images, axis=(1, 2))
    whole = np.mean(np.mean((found - images) ** 2, axis=(1, 2)) / variance)
    assert float(error_of_all) == pytest.approx(whole, rel=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize("noise", [SignalNoise(30.0), PhotonNoise(3000.0, 5.0)])
def test_gradient_by_differences(noise):
    given = training(noise, count=12, sensor=(20, 24))
    place = jnp.array([19.0, 23.0, 5.13, 6.91, 5e-4, 1.71])

    @jax.jit
    @jax.value_and_grad
    def error_and_slope(x):
        return wiener_error(design(x[:2], x[2:4], x[4], x[5]), given)

    def error(x):
        return error_and_slope(x)[0]

    slope = error_and_slope(place)[1]
    for index, value in enumerate(place):
        step = jnp.zeros(6).at[index].set(1e-5 * value)
        difference = (error(place + step) - error(place - step)) / (2e-5 * value)
        assert float(slope[index] / difference) == pytest.approx(1, abs=1e-4)


@pytest.mark.thorough
def test_coarse_pixels_carry_the_noise_of_the_fine_ones():
    """Four pixels' mean has a quarter of the variance: the same as 6 dB more light a pixel."""
    small = {"count": 12, "sensor": (20, 24)}
    coarse = training(SignalNoise(20.0), pitch=0.04, **small)
    fine = training(SignalNoise(20.0 + 20 * np.log10(2)), pitch=0.08, **small)
    error = [float(compiled(design(), given)[1]) for given in (coarse, fine)]
    assert error[0] == pytest.approx(error[1], rel=1e-9)
    noisier = training(SignalNoise(0.0), pitch=0.08, **small)
    assert float(compiled(design(), noisier)[1]) > error[1]


def test_errors():
    with pytest.raises(ValueError, match="adds 2 captures and the design takes 4"):
        wiener_error(design(), training(synthesis=phase_pairs(1)))
    with pytest.raises(ValueError, match="distance = 4 mm, and the training was made for 5 to 7"):
        wiener_error(design(distance=(4.0, 7.0)), training())
    with pytest.raises(ValueError, match="an image has no contrast"):
        Training(
            np.ones((1, 12, 12)),
            setup(),
            phase_pairs(2),
            TrainedSensor(SENSOR, (5.0, 7.0)),
            key=jax.random.key(0),
        )
    with pytest.raises(ValueError, match="give the shortest and the longest"):
        Training(
            pictures(12),
            setup(),
            phase_pairs(2),
            TrainedSensor(SENSOR, (7.0, 5.0)),
            key=jax.random.key(0),
        )
