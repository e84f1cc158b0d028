import numpy as np
import pytest

from thincam_jax.measured.blocks import block_any, block_mean, crop_to_blocks
from thincam_jax.measured.raw import MeasurementError

IMAGE = np.random.default_rng(7).normal(size=(2, 6, 9))


def direct(image, factor, known):
    """Means block by block."""
    channels, rows, columns = image.shape
    result = np.zeros((channels, rows // factor, columns // factor))
    for index in np.ndindex(result.shape):
        c, y, x = index[0], index[1] * factor, index[2] * factor
        block = image[c, y : y + factor, x : x + factor]
        chosen = block[known[c, y : y + factor, x : x + factor]]
        result[index] = chosen.mean() if chosen.size else 0
    return result


def test_block_means_of_all_and_of_the_known_pixels():
    known = np.random.default_rng(8).random(IMAGE.shape) > 0.5
    known[1, 3:6, 3:6] = False
    everything = np.ones(IMAGE.shape, bool)
    np.testing.assert_allclose(block_mean(IMAGE, 3), direct(IMAGE, 3, everything), rtol=1e-13)
    np.testing.assert_allclose(block_mean(IMAGE, 3, known), direct(IMAGE, 3, known), rtol=1e-13)
    assert block_mean(IMAGE, 3, known)[1, 1, 1] == 0
    np.testing.assert_array_equal(block_any(known, 3), direct(known, 3, everything) > 0)


def test_float32_means_lose_nothing_to_summation():
    image = np.full((1, 512, 1024), 0.1, np.float32)
    image[..., ::2] = 1e-4
    found = block_mean(image, 512)
    assert found.dtype == np.float32
    exact = np.mean([np.float64(np.float32(0.1)), np.float64(np.float32(1e-4))])
    np.testing.assert_allclose(found, np.full((1, 1, 2), exact), rtol=6e-8)


def test_crop_is_central():
    assert crop_to_blocks((12, 15), 4) == (slice(0, 12), slice(1, 13))
    assert crop_to_blocks((11, 7), 4) == (slice(1, 9), slice(1, 5))
    assert crop_to_blocks((11, 7), 1) == (slice(0, 11), slice(0, 7))
    with pytest.raises(MeasurementError, match=r"downsample = 8 is larger than the image of 11×7"):
        crop_to_blocks((11, 7), 8)
