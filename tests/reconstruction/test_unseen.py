"""What no image casts through a separable camera: noise, hot and dead pixels."""

import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.imaging.operators import Separable
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.reconstruction.unseen import unseen_defects, unseen_variance

SHAPE, FIELD = (72, 80), (40, 44)


def counts(seed, level=50.0):
    """A camera of random cells as fine as a pixel, and a capture of a photograph in photons."""
    random = np.random.default_rng(seed)
    sides = [(random.random((n, m)) < 0.5).astype(float) for n, m in zip(SHAPE, FIELD, strict=True)]
    light = sides[0] @ resize(sample_image("camera", linear=True), FIELD) @ sides[1].T
    light *= 3000 / light.max()
    noise = random.poisson(light) - light + 3 * random.standard_normal(SHAPE)
    return Separable(*sides), light + noise + level, float(np.mean(noise**2)), random


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_the_noise_beside_a_background_and_masked_pixels(share):
    """Within 10 %, also where a fifth of the pixels read nonsense; the finest detail is the code.

    Masks left the latter, a hundred times as much.
    """
    camera, capture, variance, random = counts(0)
    valid = random.random(SHAPE) >= share
    capture = jnp.asarray(np.where(valid, capture, 1e5))
    mask = [None if share == 0 else jnp.asarray(valid)]
    found = unseen_variance([camera], [capture], mask, jnp.asarray([1e9]))
    assert float(found[0]) == pytest.approx(variance, rel=0.1)


def test_lone_pixels_are_found_among_a_code_as_fine_as_a_pixel():
    """Hot and dead ones; none of clean captures. The image is as good as with a map."""
    for seed in range(20):
        camera, capture, _, _ = counts(seed)
        assert not unseen_defects(camera, capture.astype(np.float32)).any()
    places = np.random.default_rng(1).integers(0, SHAPE, (12, 2))
    odd = np.zeros(SHAPE, bool)
    odd[tuple(places.T)] = True
    for value in (4095.0, 0.0):
        given = np.where(odd, value, capture)
        np.testing.assert_array_equal(unseen_defects(camera, given.astype(np.float32)), odd)
        found = tc.Recording([given], camera)
        told = tc.Recording([given], camera, valid=[~odd])
        images = [tc.reconstruct(one, tc.AdmmTV(iterations=5)).image for one in (found, told)]
        np.testing.assert_allclose(*images, rtol=1e-5)
