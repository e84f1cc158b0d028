"""Bringing captures to one scale: enlargement about the centre, sizes, parities."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thincam_jax.reconstruction.imaging_model import register, registered_shape


def blob(y, x):
    return np.exp(-((y - 4.2) ** 2) / 30 - (x + 6.1) ** 2 / 20) + 0.5 * np.exp(
        -((y + 7.3) ** 2) / 18 - (x - 3.4) ** 2 / 50
    )


def pixels(shape):
    y, x = (np.arange(n) - (n - 1) / 2 for n in shape)
    return y[:, None], x[None, :]


@pytest.mark.parametrize(
    ("shape", "ratio"), [((38, 47), 1.3), pytest.param((41, 36), 1.031, marks=pytest.mark.thorough)]
)
def test_the_picture_is_enlarged_about_its_centre(shape, ratio):
    """A smooth function of (y, x) becomes that of (y, x)/ratio; off the sensor's rim."""
    value = jax.jit(lambda picture: register(picture, ratio))(blob(*pixels(shape)))
    assert value.shape == registered_shape(shape, ratio)
    y, x = pixels(value.shape)
    expected = blob(y / ratio, x / ratio)
    inside = (abs(y) < ratio * (shape[0] / 2 - 4)) & (abs(x) < ratio * (shape[1] / 2 - 4))
    np.testing.assert_allclose(np.asarray(value)[inside], expected[inside], atol=2e-3)
    # the light grows with the area
    total = blob(*pixels(shape)).sum()
    np.testing.assert_allclose(value.sum(), ratio**2 * total, rtol=2e-3)
    # a flip or a shift by half a pixel would show
    assert np.abs(blob(y / ratio + 0.5, x / ratio)[inside] - expected[inside]).max() > 0.05


@pytest.mark.thorough
def test_batches_and_the_ratio_of_one():
    images = jnp.asarray(np.random.default_rng(0).normal(size=(2, 3, 8, 11)))
    assert register(images, 1.0) is images
    whole = register(images, 1.4)
    np.testing.assert_allclose(whole[1, 2], register(images[1, 2], 1.4), atol=1e-14)


@pytest.mark.parametrize("ratio", [1.0, 1.001, 1.3, 2.0])
@pytest.mark.parametrize("shape", [(8, 11), (1, 96)])
def test_registered_shape_holds_the_enlarged_picture_and_its_parity(shape, ratio):
    for new, old in zip(registered_shape(shape, ratio), shape, strict=True):
        assert ratio * old - 1e-5 <= new < ratio * old + 2 and (new - old) % 2 == 0


def test_captures_are_never_made_smaller():
    with pytest.raises(ValueError, match=r"ratio = 0.8: captures are only enlarged"):
        register(jnp.ones((4, 5)), 0.8)
