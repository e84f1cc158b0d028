import jax.numpy as jnp
import numpy as np

from thincam_jax.measured import to_display


def test_grey_values_by_the_formula():
    image = np.array([[[0.0, 0.25, 1.0], [-3.0, 0.5, 0.01]]])
    found = to_display(image, percentile=100)
    expected = [[round(255 * max(v, 0.0) ** (1 / 2.2)) for v in row] for row in image[0].tolist()]
    assert found.dtype == np.uint8
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(
        to_display(8 * image, percentile=100, gamma=1),
        [[0, 64, 255], [0, 128, 3]],  # 63.75, 127.5 to even, 2.55
    )


def test_a_few_bright_pixels_do_not_darken_the_rest():
    image = np.full((1, 40, 50), 0.5)
    image[0, 3, 4] = 100.0  # one of 2000; two would be 0.1 %
    found = to_display(image, gamma=1)
    assert (found == 255).all()
    assert to_display(image, gamma=1, percentile=100)[0, 0] == 1
    # A percentile of 0 is no white: the maximum is.
    image = np.zeros((1, 80, 100))
    image[0, 3, 4], image[0, 5, 6] = 2.0, 1.0
    found = to_display(image, gamma=1)
    assert found[3, 4] == 255 and found[5, 6] == 128


def test_colours_go_last_and_are_balanced():
    image = np.random.default_rng(16).random((3, 20, 30)).astype(np.float32)
    image *= np.array([1.0, 2.0, 0.5], np.float32)[:, None, None]
    gains = to_display(image, white_balance=(2, 1, 4), gamma=1, percentile=100)
    scaled = np.moveaxis(image.astype(float) * np.array([2, 1, 4])[:, None, None], 0, -1)
    np.testing.assert_array_equal(gains, np.round(255 * scaled / scaled.max()))
    grey = to_display(image, white_balance="grey_world", gamma=1, percentile=100)
    means = grey.reshape(-1, 3).mean(axis=0)
    np.testing.assert_allclose(means, means.mean(), rtol=2e-3)
    assert np.ptp(to_display(image, gamma=1).reshape(-1, 3).mean(axis=0)) > 50


def test_a_black_channel_and_a_black_image_stay_so():
    image = np.ones((3, 4, 5))
    image[1] = 0
    found = to_display(image, white_balance="grey_world")
    assert (found[..., 1] == 0).all() and (found[..., 0] == 255).all()
    assert not to_display(np.zeros((1, 4, 5))).any()
    assert to_display(jnp.ones((1, 4, 5), dtype=jnp.float32)).min() == 255
