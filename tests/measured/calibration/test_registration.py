"""Registration against scenes that are drawn, in closed form, at another scale and place."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thincam_jax.measured.calibration import estimate_registration
from thincam_jax.measured.calibration.registration import covered, resample

SHAPE = (150, 181)


def blobs(scale=1.0, shift=(0.0, 0.0), seed=0):
    """Gaussian blobs of 1.5 to 10 pixels, enlarged about the middle and moved."""
    rng = np.random.default_rng(seed)
    y, x = ((np.arange(n) - (n - 1) / 2 - a) / scale for n, a in zip(SHAPE, shift, strict=True))
    image = np.zeros(SHAPE)
    for _ in range(60):
        y0, x0 = rng.uniform(-105, 105, 2)
        size, height = rng.uniform(1.5, 10.0), rng.uniform(-1, 1)
        down, across = (np.exp(-((r - c) ** 2) / (2 * size**2)) for r, c in ((y, y0), (x, x0)))
        image += height * down[:, None] * across
    return image


def noisy(image, part, seed):
    return image + part * image.std() * np.random.default_rng(seed).normal(size=image.shape)


def waves(scale, shift, shape=SHAPE):
    """Twelve plane waves of up to 0.3 cycles a pixel, enlarged about the middle and moved."""
    rng = np.random.default_rng(4)
    y, x = (
        (jnp.arange(n, dtype=float) - (n - 1) / 2 - a) / scale
        for n, a in zip(shape, shift, strict=True)
    )
    image = 0.0
    for _ in range(12):
        v, u, phase = rng.uniform(-0.21, 0.21, 2).tolist() + [rng.uniform(0, 6)]
        image = image + jnp.cos(2 * jnp.pi * (v * y[:, None] + u * x) + phase)
    return image


class TestResample:
    """Against waves in closed form, and their derivatives."""

    @pytest.mark.thorough
    @pytest.mark.parametrize(
        ("scale", "shift"), [(1.07, (2.3, -4.6)), (1.3, (0.0, 0.5)), (1.0, (3.0, -2.0))]
    )
    def test_values_and_derivatives(self, scale, shift):
        image = jax.jit(waves)(1.0, (0.0, 0.0))
        at = jnp.asarray(scale), jnp.asarray(shift)

        @jax.jit
        def both(scale, shift):
            return resample(image, scale, shift), waves(scale, shift)

        # Six pixels: five lobes of the kernel, and one for rounding up.
        inside = np.asarray(covered(SHAPE, *at, 6)) > 0
        found, exact = map(np.asarray, both(*at))
        assert inside.mean() > 0.5
        assert rms((found - exact)[inside]) < 4e-3 * rms(exact)
        for found, exact in zip(*jax.jit(jax.jacfwd(both, (0, 1)))(*at), strict=True):
            found, exact = np.asarray(found)[inside], np.asarray(exact)[inside]
            assert rms(found - exact) < 2.5e-2 * rms(exact)

    def test_border(self):
        """Zero beyond the edges, between the image's own values up to them."""
        found = np.asarray(resample(jnp.ones(SHAPE), jnp.asarray(0.8), jnp.array([4.0, 0.0])))
        y, x = ((np.arange(n) - (n - 1) / 2 - a) / 0.8 for n, a in zip(SHAPE, (4, 0), strict=True))
        shown = (np.abs(y)[:, None] <= SHAPE[0] / 2) & (np.abs(x) <= SHAPE[1] / 2)
        np.testing.assert_allclose(found, shown, atol=1e-12)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(
    ("scale", "shift"), [(1.08, (3.3, -2.7)), (0.91, (-13.3, 7.7)), (1.0, (0.5, 0.0))]
)
@pytest.mark.thorough
def test_scale_and_shift(scale, shift):
    """30 dB: the scale to 1e-4, the shift to 0.05 pixel, and within the errors claimed."""
    capture = noisy(5.0 + 2.0 * blobs(scale, shift), 0.03, 1)
    found = estimate_registration(capture, noisy(blobs(), 0.03, 2))
    assert (found.status, found.reasons) == ("ok", ())
    assert abs(float(found.scale) - scale) < min(2e-4, 4.5 * float(found.scale_error))
    assert abs(float(found.scale) - scale) < 1e-4
    off = np.abs(np.asarray(found.shift) - shift)
    assert np.all(off < 0.05)
    assert np.all(off < 4.5 * np.asarray(found.shift_error))
    assert float(found.shift_error.max()) < 0.02


@pytest.mark.thorough
def test_different_scenes_are_a_poor_fit():
    found = estimate_registration(blobs(seed=1), blobs(seed=2))
    assert found.status in ("poor_fit", "not_converged")
    assert any("correlate" in line for line in found.reasons)
