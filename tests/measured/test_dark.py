"""Black levels that nobody gave."""

import warnings

import numpy as np
import pytest
import scipy.ndimage

from thincam_jax.measured import Raw, prepare
from thincam_jax.measured.merging import find_levels

SHAPE, BLACK = (48, 64), 64


def counts(light, seed, noise=3.0):
    generator = np.random.default_rng(seed)
    pixels = np.round(BLACK + light + noise * generator.normal(size=light.shape))
    return Raw(np.clip(pixels, 0, 4095).astype(np.uint16), 12)


def zones():
    y, x = (np.arange(n) - (n - 1) / 2 for n in SHAPE)
    return 1500 * (1 + np.cos(0.01 * (y[:, None] ** 2 + x**2)))


def spots(seed):
    """A random mask in a dark surround."""
    light = np.zeros(SHAPE)
    light[16:32, 20:44] = 3000 * (np.random.default_rng(seed).random((16, 24)) < 0.5)
    return light


def blurred(seed):
    """A capture, nowhere dark."""
    light = np.random.default_rng(seed).random(SHAPE)
    return 800 + 3000 * scipy.ndimage.gaussian_filter(light, 6)


def test_a_psf_that_fills_the_sensor_has_no_dark_corner():
    psf, capture = counts(zones(), 1), counts(blurred(2), 3)
    with pytest.warns(UserWarning, match="no corner of the PSF .* is dark.*number of counts"):
        found = prepare(psf, capture)
    log = found.log
    assert (log.psf.background, log.capture.background) == ("lowest value", "found with the image")
    assert log.capture.level == (0.0,) and abs(4095 * log.psf.level[0] - BLACK) < 40
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        prepare(psf, capture, background=BLACK)  # as the warning advises
        untested = prepare(psf, capture, background="corner").log
    assert untested.psf.background == "corner" and untested.psf.clipped > 0.5 * psf.pixels.size
    assert log.psf.clipped < 0.2 * untested.psf.clipped


def test_dark_corners_are_found_dark():
    for seed in range(40):
        noise = (0.3, 1, 3, 10)[seed % 4]
        pair = counts(spots(seed), seed, noise), counts(blurred(seed), seed + 100, noise)
        planes = [one.pixels[None].astype(np.float32) for one in pair]
        found = find_levels(dict(zip(("psf", "capture"), planes, strict=True)), (5, 15), None)
        assert set(found.sources.values()) == {"corner"}
        assert abs(float(found.levels["psf"][0, 0, 0]) - BLACK) < noise


def test_another_corner_and_a_capture_that_is_darker():
    light = spots(1)
    light[:20, :20] = 2000
    found = prepare(counts(light, 2), counts(blurred(3), 4))
    assert found.log.psf.background == "corner" and abs(4095 * found.log.psf.level[0] - 64) < 2
    light[light == 0] = 600  # ambient light of the PSF alone
    light[:20, :20] = 600
    found = prepare(counts(light, 2), counts(spots(3), 4))
    assert found.log.psf.background == "corner"
    assert found.log.capture.background == "found with the image"
