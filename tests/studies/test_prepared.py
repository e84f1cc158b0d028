"""Prepared captures: their noise, and the image over the field or in front of the sensor."""

import numpy as np
import pytest
from commands.reconstruct import simulated

import thincam_jax as tc
from thincam_jax.measured import Preparation, Raw, prepare
from thincam_jax.studies.prepared import pixel_noise, prepared_recording, reconstruct_prepared

NOISE = 20.0  # counts


@pytest.fixture(scope="module")
def prepared():
    """A PSF of spots and a capture of 12 bit of two discs, with noise of 20 counts."""
    light = simulated.psf()
    view = simulated.capture(simulated.scene()[1:2], light)[0]
    images = (simulated.counts(light, 3), simulated.counts(view, 10, noise=NOISE))
    psf, capture = (Raw(image.astype(np.uint16), bits=12) for image in images)
    return prepare(psf, capture, background=float(simulated.DARK), options=Preparation())


def test_noise_in_counts_of_a_raw_pixel(prepared):
    given, found = pixel_noise(prepared, NOISE), pixel_noise(prepared)
    assert given.counts == pytest.approx(NOISE) and given.found == "given"
    assert found.counts == pytest.approx(NOISE, rel=0.25) and found.found.startswith("estimated")
    assert found.deviation / found.counts == pytest.approx(given.deviation / given.counts)
    scale = 4095 * prepared.log.capture_divisor
    assert given.deviation == pytest.approx(NOISE / scale)


def test_the_image_is_the_middle_of_the_field(prepared):
    noise = pixel_noise(prepared)
    done = reconstruct_prepared(prepared, tc.Ridge(1.0), noise)
    rows, columns = simulated.SHAPE
    whole, image = done.image("full"), done.image()
    assert whole.shape == (1, 2 * rows - 1, 2 * columns - 1) and image.shape == (1, rows, columns)
    top, left = ((n - m) // 2 for n, m in zip(whole.shape[1:], image.shape[1:], strict=True))
    np.testing.assert_array_equal(image, whole[:, top : top + rows, left : left + columns])
    assert simulated.correlation(image[0], simulated.scene()[1]) > 0.6
    assert done.pixel_deviation == pytest.approx(noise.deviation, rel=1e-3)
    assert 0 < done.relative_residual < 0.3


def test_a_recording_without_noise_leaves_it_to_the_solver(prepared):
    assert prepared_recording(prepared).noise_variance is None
    assert prepared_recording(prepared, pixel_noise(prepared, NOISE)).noise_variance is not None
