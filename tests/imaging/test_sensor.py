"""Noise at its stated strength, saturation, digitisation, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.imaging.sensor import electrons_per_unit, read_out


def ramp(shape=(200, 301), mean=0.7):
    """An image with a mean and a variance that differ."""
    x = np.linspace(-0.5, 0.5, shape[1])
    return jnp.asarray(mean + np.broadcast_to(x, shape) * 0.6)


@pytest.mark.parametrize("snr_db", [10.0, 30.0])
@pytest.mark.parametrize("power", ["total", "without_mean"])
def test_gaussian_noise_has_the_stated_snr(key, power, snr_db):
    """60,000 pixels measure σ² to 0.6 %, 0.03 dB: within 0.1 dB."""
    image = ramp()
    noisy = read_out(
        tc.Sensor(image.shape, 0.01), image, noise=tc.GaussianNoise(snr_db, power), key=key
    )
    noise = np.asarray(noisy - image)
    signal = np.mean(image**2) if power == "total" else np.var(image)
    assert abs(10 * np.log10(signal / noise.var()) - snr_db) < 0.1
    assert abs(noise.mean()) < 5 * noise.std() / np.sqrt(noise.size)
    assert noise.min() < 0  # nothing is clipped on an ideal sensor


def test_every_image_of_a_batch_has_its_own_noise(key):
    image = ramp()
    batch = jnp.stack([image, 3.0 * image, image])
    noisy = read_out(tc.Sensor((200, 301), 0.01), batch, noise=tc.GaussianNoise(20.0), key=key)
    noise = np.asarray(noisy - batch)
    np.testing.assert_allclose(noise.std(axis=(1, 2)) / noise[0].std(), [1, 3, 1], rtol=0.02)
    assert abs(np.corrcoef(noise[0].ravel(), noise[2].ravel())[0, 1]) < 0.02


def test_shot_noise_variance_is_its_mean(key):
    """The brightest pixel holds exposure·full_well electrons; the rest in proportion."""
    levels = jnp.repeat(jnp.array([[0.05, 0.3, 1.0]]), 60_000, axis=0)
    sensor = tc.Sensor(levels.shape, 0.01, full_well=2000.0, exposure=0.5)
    noisy = read_out(sensor, levels, noise=tc.PoissonGaussianNoise(1e-6), key=key)
    electrons = np.asarray(noisy) * 1000.0
    np.testing.assert_allclose(electrons.mean(axis=0), [50, 300, 1000], rtol=0.005)
    np.testing.assert_allclose(electrons.var(axis=0), [50, 300, 1000], rtol=0.03)
    np.testing.assert_allclose(electrons, np.round(electrons), atol=1e-4)


def test_read_noise_adds_its_variance(key):
    levels = jnp.repeat(jnp.array([[0.04, 0.5, 1.0]]), 60_000, axis=0)
    sensor = tc.Sensor(levels.shape, 0.01, full_well=1000.0, exposure=0.5)
    noisy = read_out(sensor, levels, noise=tc.PoissonGaussianNoise(12.0), key=key)
    # The dark level would reach below zero, where the sensor clips: compare the bright one.
    variance = np.var(np.asarray(noisy)[:, 2] * 500.0)
    np.testing.assert_allclose(variance, 500.0 + 144.0, rtol=0.03)


def test_saturates_at_the_full_well():
    """Exposed to twice the full well, what is above half the brightest pixel reads as half."""
    image = jnp.array([[0.0, 1.0, 1.9], [2.0, 3.0, 4.0]])
    sensor = tc.Sensor((2, 3), 0.01, exposure=2.0)
    np.testing.assert_allclose(read_out(sensor, image), [[0, 1, 1.9], [2, 2, 2]], rtol=1e-14)
    np.testing.assert_array_equal(read_out(tc.Sensor((2, 3), 0.01), image), image)
    assert read_out(sensor, -image).min() == 0.0


def test_each_image_of_a_batch_is_exposed_on_its_own():
    image = jnp.array([[0.5, 1.0]])
    both = read_out(tc.Sensor((1, 2), 0.01, exposure=2.0), jnp.stack([image, 10 * image]))
    np.testing.assert_allclose(both[:, 0], [[0.5, 0.5], [5.0, 5.0]])


def test_electrons_are_the_same_for_every_image(key):
    """1000 from each mm², however bright the image; what is more than the well holds is lost."""
    levels = jnp.repeat(jnp.array([[0.05, 0.3, 1.0]]), 60_000, axis=0)
    sensor = tc.Sensor(levels.shape, 0.01, electrons=1000.0, full_well=1e5)
    both = jnp.stack([levels, 10 * levels])
    noisy = np.asarray(read_out(sensor, both, noise=tc.PoissonGaussianNoise(1e-6), key=key)) * 1000
    np.testing.assert_allclose(noisy.mean(axis=1), [[50, 300, 1000], [500, 3000, 1e4]], rtol=0.005)
    np.testing.assert_allclose(noisy.var(axis=1), [[50, 300, 1000], [500, 3000, 1e4]], rtol=0.03)
    full = tc.Sensor((1, 3), 0.01, electrons=1000.0, full_well=300.0, bit_depth=2)
    np.testing.assert_allclose(read_out(full, 0.8 * levels[:1]), [[0.0, 0.2, 0.3]], atol=1e-12)
    counted = electrons_per_unit(full, both)
    assert counted.shape == (2, 1, 1)
    np.testing.assert_array_equal(counted, 1000.0)


def test_quantisation():
    """2 bits: levels at 0, ⅓, ⅔ and 1 of the full well, here 1.25 of the brightest pixel."""
    image = jnp.linspace(0.0, 1.0, 401)[None]
    value = np.asarray(read_out(tc.Sensor((1, 401), 0.01, exposure=0.8, bit_depth=2), image))
    np.testing.assert_allclose(np.unique(value), [0, 1.25 / 3, 2.5 / 3], atol=1e-14)  # 1 → ⅔
    np.testing.assert_allclose(value, np.round(image / (1.25 / 3)) * 1.25 / 3, atol=1e-12)
    fine = read_out(tc.Sensor((1, 401), 0.01, exposure=0.8, bit_depth=12), image)
    error = np.abs(fine - image).max()
    assert 0.4 * 1.25 / 4095 < error <= 0.5001 * 1.25 / 4095


def test_differentiable_through_the_noise(key):
    """d/ds of s·image + σ(s)·n is image + σ n: the noise of a fixed key scales with the image."""
    image, sensor = ramp((5, 7)), tc.Sensor((5, 7), 0.01)

    def total(scale):
        noisy = read_out(sensor, scale * image, noise=tc.GaussianNoise(20.0), key=key)
        return jnp.sum(noisy * image)

    np.testing.assert_allclose(jax.grad(total)(1.5), total(1.0), rtol=1e-12)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: tc.Sensor((4, 5), 1.0, bit_depth=8), "bit_depth needs an exposure"),
        (lambda: tc.Sensor((4, 5), 1.0, exposure=1.0, electrons=9.0), "how long .* give one"),
        (
            lambda: read_out(tc.Sensor((1, 1), 1.0), jnp.ones((1, 1)), noise=tc.GaussianNoise(9.0)),
            r"noise needs a key: pass key=seed, such as key=0",
        ),
        (
            lambda: read_out(
                tc.Sensor((1, 1), 1.0),
                jnp.ones((1, 1)),
                noise=tc.PoissonGaussianNoise(),
                key=jax.random.key(0),
            ),
            "give the Sensor an exposure",
        ),
    ],
)
def test_refusals(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_a_pitch_in_micrometres_is_refused():
    with pytest.raises(ValueError, match=r"pitch = 5.5 mm is no pixel: .*5.5 \* um"):
        tc.Sensor((3, 4), 5.5)
