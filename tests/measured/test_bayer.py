"""Mosaics, the clean-up of a PSF, and its dark corner."""

import warnings

import numpy as np
import pytest
import scipy.ndimage

from thincam_jax.measured import Raw, prepare
from thincam_jax.measured.bayer import PATTERNS, demosaic, demosaic_mask, mosaic
from thincam_jax.measured.merging import find_levels
from thincam_jax.measured.preparation import centre_psf, clean


def mosaic_of(image, pattern):
    """What a sensor with that pattern sees of an image (y, x, 3), pixel by pixel."""
    rows, columns, _ = image.shape
    seen = np.empty((rows, columns), image.dtype)
    for y in range(rows):
        for x in range(columns):
            seen[y, x] = image[y, x, "RGB".index(pattern[2 * (y % 2) + x % 2])]
    return seen


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_mosaic_has_one_colour_at_each_pixel(pattern):
    colours = np.random.default_rng(3).normal(size=(2, 3, 5, 8))
    for one, image in zip(mosaic(colours, pattern), colours, strict=True):
        np.testing.assert_array_equal(one, mosaic_of(np.moveaxis(image, 0, -1), pattern))


@pytest.mark.parametrize("pattern", PATTERNS)
def test_bilinear_is_the_mean_of_the_nearest_samples(pattern):
    """Against a direct search of the nearest samples of noise, at every pixel."""
    image = np.random.default_rng(4).normal(size=(7, 10, 3))
    mosaic = mosaic_of(image, pattern)
    found = demosaic(mosaic, pattern)
    for y in range(7):
        for x in range(10):
            for c in range(3):
                near = {}
                for v in range(max(y - 1, 0), min(y + 2, 7)):
                    for u in range(max(x - 1, 0), min(x + 2, 10)):
                        if pattern[2 * (v % 2) + u % 2] == "RGB"[c]:
                            distance = abs(v - y) + abs(u - x)
                            near.setdefault(distance, []).append(mosaic[v, u])
                if 0 in near and 2 in near:  # green: its diagonal neighbours do not count
                    near = {0: near[0]}
                np.testing.assert_allclose(found[y, x, c], np.mean(near[min(near)]), atol=1e-14)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_superpixel_takes_the_samples_as_they_are(pattern):
    image = np.random.default_rng(5).normal(size=(6, 10, 3))
    mosaic = mosaic_of(image, pattern)
    found = demosaic(mosaic, pattern, "superpixel")
    assert found.shape == (3, 5, 3)
    quarters = {}
    for place, colour in enumerate(pattern):
        quarters.setdefault(colour, []).append(mosaic[place // 2 :: 2, place % 2 :: 2])
    for c, colour in enumerate("RGB"):
        np.testing.assert_allclose(found[..., c], np.mean(quarters[colour], axis=0), rtol=1e-14)


def test_counts_become_float32_and_float64_stays():
    mosaic = np.random.default_rng(6).integers(0, 65536, (6, 8)).astype(np.uint16)
    exact = demosaic(mosaic.astype(np.float64), "RGGB")
    assert exact.dtype == np.float64
    found = demosaic(mosaic, "RGGB")
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, exact, rtol=3e-7)


def test_unknown_samples_are_left_out():
    image = np.full((6, 8, 3), 2.0)
    mosaic, known = mosaic_of(image, "RGGB"), np.ones((6, 8), bool)
    mosaic[2, 4], known[2, 4] = 1e6, False  # a red one
    found = demosaic(mosaic, "RGGB", "bilinear", known)
    has = demosaic_mask(known, "RGGB")
    np.testing.assert_allclose(found[has], 2.0, rtol=1e-14)
    # Nobody but that pixel sees the red at its own place.
    assert np.argwhere(~has).tolist() == [[2, 4, 0]]
    assert found[2, 4, 0] == 0
    has = demosaic_mask(known, "RGGB", "superpixel")
    assert np.argwhere(~has).tolist() == [[1, 2, 0]]


def test_noise_level_counts_where_it_is_the_larger():
    psf = np.array([[[8.0, 1.0, 0.5, 0.2]]])
    for noise, kept in ((0.3, 2), (0.1, 3), (0.01, 4)):
        found, record = clean(psf, np.array([noise]), 0.02, 3)
        assert np.count_nonzero(found) == kept
        np.testing.assert_allclose(record.level, [max(0.16, 3 * noise)])
    found, record = clean(psf, np.array([0.3]))
    np.testing.assert_array_equal(found, psf)
    assert record.zeroed == record.light_removed == 0


@pytest.mark.parametrize("by", ["centroid", "peak", "symmetry"])
@pytest.mark.parametrize("size", [(9, 12), (8, 11)])
def test_a_single_pixel_comes_to_the_origin_of_a_dft(by, size):
    psf = np.zeros((2, *size), np.float32)
    psf[:, 1, 8] = 3, 1
    found, record = centre_psf(psf, by)
    assert np.argwhere(found[0]).tolist() == [[size[0] // 2, size[1] // 2]]
    assert record.shift == (size[0] // 2 - 1, size[1] // 2 - 8)
    assert record.light_lost == 0
    # In the place where a DFT has its origin, by another library:
    assert np.argwhere(np.fft.ifftshift(found[1])).tolist() == [[0, 0]]


def test_the_three_centres_of_a_lopsided_pair():
    psf = np.zeros((1, 11, 21))
    psf[0, 4, 3], psf[0, 4, 7] = 1.0, 1.5
    found = {by: centre_psf(psf, by)[1].found for by in ("centroid", "peak", "symmetry")}
    np.testing.assert_allclose(found["centroid"], [4, (3 + 1.5 * 7) / 2.5])
    assert found["peak"] == (4, 7)
    assert found["symmetry"] == (4, 5)  # of 1 at 3 + 3, 2·1.5 at 3 + 7 and 1.5² at 7 + 7


def test_symmetry_is_not_drawn_aside_by_a_bright_side():
    """A symmetric pattern of irregular dots with one more: the centroid moves, this does not."""
    generator = np.random.default_rng(9)
    half = (generator.random((15, 19)) < 0.2) * 1.0
    pattern = half + half[::-1, ::-1]
    psf = np.zeros((1, 40, 50))
    psf[0, 3:18, 20:39] = pattern
    psf[0, 38, 2] = 10.0
    centre, record = centre_psf(psf, "symmetry")
    assert record.found == (10.0, 29.0)
    assert abs(centre_psf(psf, "centroid")[1].found[0] - 10.0) > 1
    # 19.5 − 10 and 24.5 − 29, rounded up; the dot leaves the array.
    assert record.shift == (10, -4)
    np.testing.assert_array_equal(centre[0, 13:28, 16:35], pattern)
    np.testing.assert_allclose(record.light_lost, 10 / psf.sum())


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
