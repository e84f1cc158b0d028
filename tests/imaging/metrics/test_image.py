"""PSNR and SSIM against their definitions, after an alignment whose answer is known."""

import math

import numpy as np
import pytest

from thincam_jax.imaging.metrics import align, psnr, ssim
from thincam_jax.imaging.metrics.image import fit_levels

RNG = np.random.default_rng(7)
GREY = RNG.uniform(size=(23, 40))
COLOUR = RNG.uniform(size=(23, 40, 3))


def test_align_inverts_an_affine_change():
    aligned, gain, offset = fit_levels(4.0 * GREY - 3.0, GREY)
    assert aligned == pytest.approx(GREY, abs=1e-12)
    assert (float(gain), float(offset)) == pytest.approx((0.25, 0.75))
    np.testing.assert_array_equal(align(4.0 * GREY - 3.0, GREY), aligned)


def test_align_has_one_gain_for_each_channel():
    image = COLOUR * [2.0, 0.5, -1.0] + [0.1, 0.2, 0.3]
    aligned, gain, offset = fit_levels(image, COLOUR)
    assert aligned == pytest.approx(COLOUR, abs=1e-12)
    assert gain == pytest.approx([0.5, 2.0, -1.0])
    assert offset == pytest.approx([-0.05, -0.4, 0.3])


def test_align_is_the_least_squares_line():
    image = GREY + RNG.normal(scale=0.4, size=GREY.shape)
    aligned, gain, offset = fit_levels(image, GREY)
    slope, intercept = np.polyfit(image.ravel(), GREY.ravel(), 1)
    assert (float(gain), float(offset)) == pytest.approx((slope, intercept))
    assert aligned == pytest.approx(slope * image + intercept)
    assert float(gain) < 0.6  # noise in the image shrinks it: var(s)/(var(s) + var(n)) = 0.34


def test_align_of_a_constant_image():
    aligned, gain, offset = fit_levels(np.full(GREY.shape, 0.1), GREY)
    assert float(gain) == 0.0
    assert float(offset) == pytest.approx(GREY.mean())
    assert aligned == pytest.approx(np.full(GREY.shape, GREY.mean()))
    dead = COLOUR.copy()
    dead[..., 1] = 0.0
    assert fit_levels(dead, COLOUR)[1] == pytest.approx([1.0, 0.0, 1.0])


def test_psnr_of_a_known_error():
    """±0.1 in a checkerboard: an error of 0.01 in the square, 20 dB below a range of 1."""
    sign = np.where(np.indices(GREY.shape).sum(axis=0) % 2, 1.0, -1.0)
    assert psnr(GREY + 0.1 * sign, GREY, aligned=False) == pytest.approx(20.0)
    assert psnr(GREY + 0.1 * sign, GREY, data_range=10.0, aligned=False) == pytest.approx(40.0)
    assert psnr(GREY + 0.1, GREY, aligned=False) == pytest.approx(20.0)


def test_psnr_after_alignment_is_that_of_the_correlation():
    """The residual of a least-squares fit is var(reference)·(1 − correlation²)."""
    image = 5.0 + 3.0 * (GREY + RNG.normal(scale=0.1, size=GREY.shape))
    correlation = np.corrcoef(image.ravel(), GREY.ravel())[0, 1]
    expected = -10 * math.log10(GREY.var() * (1 - correlation**2))
    assert psnr(image, GREY) == pytest.approx(expected)
    assert psnr(image, GREY, aligned=False) < 0 < expected


def test_integer_images_do_not_wrap_round():
    reference = np.full((8, 9), 200, np.uint8)
    assert psnr(reference + np.uint8(5), reference, data_range=255, aligned=False) == pytest.approx(
        20 * math.log10(255 / 5)
    )
    assert psnr(reference, reference + np.uint8(5), data_range=255, aligned=False) == pytest.approx(
        20 * math.log10(255 / 5)
    )


def test_ssim_of_an_offset_is_its_luminance_term():
    """Equal structure on constants a and b: (2ab + C₁)/(a² + b² + C₁), C₁ = 0.01²."""
    a, b = np.full((12, 15), 0.3), np.full((12, 15), 0.6)
    expected = (2 * 0.3 * 0.6 + 1e-4) / (0.3**2 + 0.6**2 + 1e-4)
    assert ssim(a, b, aligned=False) == pytest.approx(expected)
    assert ssim(a, b) == pytest.approx(1.0)


def test_ssim_sees_structure_and_alignment():
    noise = RNG.normal(scale=0.1, size=GREY.shape)
    values = [ssim(GREY + s * noise, GREY) for s in (0.0, 1.0, 3.0)]
    assert values[0] > values[1] > values[2] > 0
    assert ssim(0.2 * GREY + 0.5, GREY) == pytest.approx(1.0)
    assert ssim(0.2 * GREY + 0.5, GREY, aligned=False) < 0.6


def test_ssim_of_colours_is_the_mean_over_channels():
    image = COLOUR + RNG.normal(scale=[0.02, 0.1, 0.4], size=COLOUR.shape)
    channels = [ssim(image[..., c], COLOUR[..., c]) for c in range(3)]
    assert ssim(image, COLOUR) == pytest.approx(np.mean(channels))
    assert np.ptp(channels) > 0.3
