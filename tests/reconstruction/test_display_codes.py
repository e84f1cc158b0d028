"""Captures that are codes for a display are said, and decoding them mends the image."""

import numpy as np
import pytest
import scipy.ndimage
import scipy.signal

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.reconstruction.display_codes import CODES

SHAPE = (64, 76)
RNG = np.random.default_rng(7)
SCENE = np.zeros(SHAPE)
SCENE[16:44, 18:36], SCENE[30:52, 30:58], SCENE[20:28, 44:60] = 0.25, 0.5, 1.0
CODE = np.kron(RNG.random((7, 9)) < 0.4, np.ones((3, 3)))
POINT = scipy.ndimage.gaussian_filter(np.pad(CODE.astype(float), 5), 0.7)


def light_of(full, read, seed=0):
    """Capture and PSF of a linear sensor, in counts of 8 bits without rounding."""
    generator = np.random.default_rng(seed)

    def exposed(image):
        electrons = generator.poisson(full * image / image.max()) if full else 255 * image
        counts = electrons * (255 / full if full else 1 / image.max())
        return np.clip(counts + read * generator.standard_normal(image.shape), 0, 255)

    return exposed(scipy.signal.fftconvolve(SCENE, POINT, "same").clip(0)), exposed(POINT)


def codes(light):
    """8-bit codes of sRGB."""
    u = light / 255
    code = np.where(u < 0.0031308, 12.92 * u, 1.055 * np.maximum(u, 1e-9) ** (1 / 2.4) - 0.055)
    return np.round(255 * code)


def image_of(capture, psf, solver=None):
    recording = tc.Recording([capture], tc.Psfs(psf[None]))
    result = tc.reconstruct(recording, solver or tc.AdmmTV(iterations=60))
    image = np.asarray(result.image)
    return relative_l2(image * np.vdot(image, SCENE) / np.vdot(image, image), SCENE), result.reason


@pytest.mark.parametrize("is_psf", [False, True])
def test_codes_are_said_and_the_advice_mends_the_image(is_psf):
    capture, psf = light_of(4000, 0.3)
    coded = codes(capture), codes(psf) if is_psf else psf
    wrong, said = image_of(*coded)
    assert said.endswith(CODES) and "give raw frames, or (captures / 255) ** 2.2" in CODES
    light = [255 * (one / 255) ** 2.2 for one in coded]
    mended, said = image_of(light[0], light[1] if is_psf else psf)
    right, _ = image_of(capture, psf)
    assert CODES not in said and mended < 1.2 * right and mended < 0.6 * wrong
    assert CODES in image_of(*coded, solver=tc.Ridge())[1]


@pytest.mark.parametrize("change", ["none", "background", "blurred", "larger"])
@pytest.mark.parametrize(("full", "read"), [(4000, 0.3), (0, 0.5), (0, 4.0)])
def test_light_is_not(change, full, read):
    """Also where its noise is even, and the PSF wrong."""
    capture, psf = light_of(full, read)
    capture = capture + 40 * (change == "background")
    if change == "blurred":
        psf = scipy.ndimage.gaussian_filter(psf, 1.0)
    if change == "larger":
        psf = scipy.ndimage.zoom(psf, 1.05, order=1)[2:-1, 2:-2]
    assert CODES not in image_of(capture, psf)[1]
