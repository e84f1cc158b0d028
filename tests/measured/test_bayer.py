import numpy as np
import pytest

from thincam_jax.measured.bayer import PATTERNS, demosaic, demosaic_mask, mosaic


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


def test_what_is_refused():
    with pytest.raises(ValueError, match=r"joins 2×2 pixels and the mosaic has 5×6.*'bilinear'"):
        demosaic(np.zeros((5, 6)), "RGGB", "superpixel")
    with pytest.raises(ValueError, match=r"has 1×6 pixels; give at least 2×2"):
        demosaic(np.zeros((1, 6)), "RGGB")
