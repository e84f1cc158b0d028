"""The noise of a capture, against noise of which the size is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

import thincam_jax as tc
from thincam_jax.imaging.operators import Separable
from thincam_jax.reconstruction.noise import estimate_noise, estimate_variance

compiled = jax.jit(estimate_noise)
RNG = np.random.default_rng(9)


@pytest.mark.thorough
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


def disc_capture(black, peak, electrons, read, bits):
    """Counts of a disc behind a diffuser, and the root mean square of their noise."""
    random, (y, x) = np.random.default_rng(3), np.ogrid[-47.5:48, -63.5:64]
    radius = {0.0: 200, 0.6: 38, 0.9: 19}[black]  # of what the light reaches, pixels
    grain = scipy.ndimage.gaussian_filter(random.normal(size=(96, 128)), 5)
    light = np.clip(1 - np.hypot(y, x) / radius, 0, 0.7) * (1 + 0.3 * grain / grain.std()).clip(0.1)
    light *= peak / light.max()
    counts = random.poisson(light * electrons) / electrons if electrons else light
    counts = counts + read * random.normal(size=light.shape)
    counts = np.clip(np.round(counts), 0, 2**bits - 1) if bits else counts
    return counts, (counts - light).std()


@pytest.mark.parametrize("black", [0.0, 0.6, 0.9])
@pytest.mark.parametrize(
    ("peak", "electrons", "read", "bits"),
    [
        (1000, 0, 10, None),
        (1000, 0.5, 1, None),
        (12, 8, 0, 8),
        (60, 8, 0, 8),
        (200, 8, 0.5, 8),
        (200, 0, 2, 8),
        (800, 2, 0.5, 10),
        (800, 0, 4, 10),
        (3200, 0.5, 0.5, 12),
        (3200, 0, 20, 12),
    ],
)
def test_noise_is_found_whatever_is_black(black, peak, electrons, read, bits):
    """Within 20 % of the true one, of light and of the electronics, black to the last count or not.

    Also of counts less a background that is no whole number, in parts of the brightest.
    """
    counts, true = disc_capture(black, peak, electrons, read, bits)
    if bits and not read:
        assert np.mean(counts == 0) == pytest.approx(black, abs=0.1)
    assert float(compiled(jnp.asarray(counts, jnp.float32))) == pytest.approx(true, rel=0.2)
    if bits and not read:
        prepared = jnp.asarray(np.maximum(counts - 0.37, 0) / peak, jnp.float32)
        assert peak * float(compiled(prepared)) == pytest.approx(true, rel=0.2)


def test_outliers_do_not_count():
    """Dead pixels, 2 % of them, move a median little and a standard deviation much."""
    random = np.random.default_rng(0)
    noise = random.normal(size=(200, 201))
    dead = random.uniform(size=noise.shape) < 0.02
    value = float(estimate_noise(jnp.asarray(np.where(dead, 1e4, noise))))
    assert value == pytest.approx(1.0, rel=0.3)
    assert float(estimate_noise(jnp.asarray(noise), jnp.asarray(~dead))) < 1.05


def test_what_is_even_has_none_and_a_ramp_of_counts_that_of_rounding():
    y, x = np.arange(12.0)[:, None], np.arange(17.0)
    for image in (np.full((12, 17), 3.0), 2.0 * ((y - 5) ** 2 + (x - 8) ** 2 < 9)):
        assert float(estimate_noise(jnp.asarray(image))) == 0.0
    for image in (2 * y - 5 * x, y**2 + np.abs(x - 4)):
        assert float(estimate_noise(jnp.asarray(image))) == pytest.approx(1 / 12**0.5)


@pytest.mark.thorough
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


@pytest.mark.parametrize("terms", [1, 2])
def test_noise_of_codes_as_fine_as_a_pixel(terms):
    """By what no image casts; the finest detail is that of the code."""
    generator = np.random.default_rng(4)
    left, right = (generator.random((terms, n, 12)) < 0.5 for n in (40, 51))
    operator = Separable(left.astype(float), right.astype(float))
    clean = np.asarray(operator(jnp.asarray(generator.random((2, 12, 12)))))
    sigma = 1e-3 * clean.max()
    capture = clean + sigma * generator.standard_normal(clean.shape)
    by_detail = float(np.sqrt(estimate_variance([jnp.asarray(capture)])[0]))
    assert by_detail > 5 * sigma
    found = 1 / np.sqrt(tc.Recording([capture], operator).problem().weights[0])
    assert float(np.ravel(found)[0]) == pytest.approx(sigma, rel=0.05)
    wide = Separable(np.eye(9, 40), np.eye(9, 51))  # nothing is left over
    (weight,) = tc.Recording([capture[0, :9, :9]], wide).problem().weights
    assert np.all(np.isfinite(weight)) and np.all(weight > 0)
