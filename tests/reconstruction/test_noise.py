"""The noise of a capture, against noise of which the size is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import count_traces
from thincam_jax.reconstruction.noise import estimate_noise, estimate_variance

RNG = np.random.default_rng(9)


@pytest.mark.parametrize("shape", [(64, 81), (111, 50), (7, 900)])
def test_white_noise_is_measured_without_bias(shape):
    """The mean of 40 estimates is right to 2 %, each one to 20 %; on a smooth picture, too."""
    y, x = (np.arange(n) for n in shape)
    picture = 100 * np.cos(y[:, None] / 40) + 3 * x + 50 * np.sin(x / 30)
    noise = 0.7 * RNG.normal(size=(40, *shape))
    for ground in (0.0, picture):
        estimates = np.asarray(estimate_noise(jnp.asarray(noise + ground)))
        assert estimates.shape == (40,)
        assert estimates.mean() == pytest.approx(0.7, rel=0.02)
        assert np.abs(estimates / 0.7 - 1).max() < 0.2


def test_outliers_do_not_count():
    """Dead pixels, 5 % of them, move a median little and a standard deviation much."""
    noise = RNG.normal(size=(200, 201))
    dead = RNG.uniform(size=noise.shape) < 0.05
    value = float(estimate_noise(jnp.asarray(np.where(dead, 1e4, noise))))
    assert value == pytest.approx(1.0, rel=0.3)


def test_what_is_even_or_a_ramp_has_none():
    y, x = np.arange(12.0)[:, None], np.arange(17.0)
    for image in (np.full((12, 17), 3.0), 2 * y - 5 * x, y**2 + np.abs(x - 4)):
        assert float(estimate_noise(jnp.asarray(image))) == 0.0
    # a checkerboard is nothing but detail: |4a| / (2·0.6745)
    board = 0.5 * (-1.0) ** (y + x)
    assert float(estimate_noise(jnp.asarray(board))) == pytest.approx(2.0 / (2 * 0.6745))


@pytest.mark.parametrize("factor", [1e-12, 1e12])
def test_it_scales(factor):
    noise = jnp.asarray(RNG.normal(size=(40, 31)), jnp.float32)
    scaled = estimate_noise(noise * jnp.float32(factor))
    assert scaled.dtype == jnp.float32
    assert float(scaled) == pytest.approx(factor * float(estimate_noise(noise)), rel=1e-6)


def test_images_too_small_have_none():
    for shape in ((1, 9), (9, 1), (3, 1, 1)):
        value = estimate_noise(jnp.ones(shape))
        np.testing.assert_array_equal(value, np.zeros(shape[:-2]))


def test_batches_and_compilation():
    images = jnp.asarray(RNG.normal(size=(2, 3, 20, 21)) * np.arange(1, 7).reshape(2, 3, 1, 1))
    counted = count_traces(estimate_noise)
    compiled = jax.jit(counted)
    values = compiled(images)
    np.testing.assert_allclose(compiled(2 * images), 2 * values)
    assert counted.traces == 1
    np.testing.assert_allclose(jax.vmap(jax.vmap(estimate_noise))(images), values)
    np.testing.assert_allclose(values[1, 2], estimate_noise(images[1, 2]))


def test_the_variance_of_each_capture():
    """Averaged over its batch; of one without noise a millionth of the power of all; or else 1."""
    captures = RNG.normal(size=(4, 3, 60, 61)) * np.array([0.5, 2.0, 0.0, 0.0]).reshape(4, 1, 1, 1)
    captures[2] = 30.0
    value = np.asarray(estimate_variance(jnp.asarray(captures)))
    np.testing.assert_allclose(value, [0.25, 4.0, 2.26e-4, 2.26e-4], rtol=0.1)
    expected = np.mean(np.asarray(estimate_noise(jnp.asarray(captures[1]))) ** 2)
    assert value[1] == pytest.approx(expected)
    scaled = estimate_variance(jnp.asarray(captures * 1e-9))
    np.testing.assert_allclose(scaled, 1e-18 * value, rtol=1e-9)
    np.testing.assert_array_equal(estimate_variance(jnp.zeros((2, 4, 5))), 1.0)
