"""A real capture and its PSF (the DiffuserCam tutorial's hand); skipped where it is absent."""

import numpy as np
import PIL.Image
import pytest
import skimage.transform

from helpers import shared_data
from thincam_jax.measured import Preparation, prepare, read_image


@pytest.fixture(scope="module")
def folder():
    return shared_data("diffusercam-hand")


@pytest.fixture(scope="module")
def raws(folder):
    return read_image(folder / "psf_sample.tif"), read_image(folder / "rawdata_hand_sample.tif")


def test_files_are_read_as_another_library_reads_them(folder, raws):
    for raw in raws:
        assert raw.pixels.shape == (1200, 1600) and raw.bits == 16
        with PIL.Image.open(raw.name) as file:
            np.testing.assert_array_equal(raw.pixels, np.array(file))


def test_preparation_agrees_with_the_tutorial_steps(raws):
    found = prepare(*raws, options=Preparation(downsample=4, capture_scale="none"))
    psf, capture = (raw.pixels.astype(np.float64) for raw in raws)
    background = psf[5:15, 5:15].mean()
    assert found.psf.shape == found.capture.shape == (1, 300, 400)
    for name in ("psf", "capture"):
        record = getattr(found.log, name)
        assert record.background == "corner"
        np.testing.assert_allclose(record.level, [background / 65535], rtol=1e-6)
    psf, capture = (
        skimage.transform.downscale_local_mean(np.maximum(image - background, 0), (4, 4))
        for image in (psf, capture)
    )
    np.testing.assert_allclose(found.psf[0], psf / psf.sum(), rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(found.capture[0], capture / 65535, rtol=1e-5)
    np.testing.assert_allclose(found.psf.sum(dtype=np.float64), 1.0, rtol=1e-6)


def test_stamp_in_the_first_two_pixels_is_left_out_as_dead(raws):
    """The camera wrote numbers there, 4 % of the PSF's peak after averaging."""
    odd = np.argwhere(raws[0].pixels % 16)
    np.testing.assert_array_equal(odd, [[0, 0], [0, 1]])
    dead = np.zeros(raws[0].pixels.shape, bool)
    dead[0, :2] = True
    options = Preparation(downsample=4)
    stamped, clean = prepare(*raws, options=options), prepare(*raws, options=options, dead=dead)
    assert stamped.psf[0, 0, 0] > 0.04 * stamped.psf.max()
    assert clean.psf[0, 0, 0] < 1e-3 * clean.psf.max()
    assert clean.valid.all()
    ratio = clean.psf[0, 1:] / np.maximum(stamped.psf[0, 1:], 1e-12)
    bright = stamped.psf[0, 1:] > 1e-6
    np.testing.assert_allclose(ratio[bright], ratio[bright].mean(), rtol=1e-5)
