"""Images to learn from: what a folder holds, and what is refused."""

import numpy as np
import PIL.Image
import pytest

from thincam_jax.learn.sources import dead_leaves, photographs


def test_photographs_are_linear_squares_in_the_order_of_their_names(tmp_path):
    for name, level in (("b", 255), ("a", 188)):
        PIL.Image.fromarray(np.full((40, 64, 3), level, np.uint8)).save(tmp_path / f"{name}.png")
    found = photographs(tmp_path, 32)
    assert found.shape == (2, 32, 32)
    np.testing.assert_allclose(found[:, 16, 16], [0.503, 1.0], atol=2e-3)


def test_a_device_among_the_photographs_is_refused(tmp_path):
    (tmp_path / "zero.png").symlink_to("/dev/zero")
    with pytest.raises(OSError, match="a device or a pipe"):
        photographs(tmp_path, 32)


def test_drawn_images_are_those_of_their_seed():
    images = dead_leaves(1, 2, 24)
    assert images.shape == (2, 24, 24) and images.min() >= 0 and images.max() <= 1
    np.testing.assert_array_equal(images, dead_leaves(1, 2, 24))
    assert np.abs(images[0] - images[1]).max() > 0.1
