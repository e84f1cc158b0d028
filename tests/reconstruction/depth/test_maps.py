"""Depth maps and sharp pictures of textures whose focus is known."""

import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction.depth import blurred

from thincam_jax.reconstruction.depth import MEASURES, RefocusSweep, all_in_focus, depth_map


@pytest.mark.parametrize("measure", MEASURES[:2])
def test_every_pixel_has_the_distance_of_its_half(measure):
    depth = depth_map(blurred.sweep(noise=0.002), measure=measure, window=5)
    halves, distance = blurred.halves(), np.asarray(depth.distance)
    for label, place in ((1, blurred.LEFT), (2, blurred.RIGHT)):
        inside = distance[halves == label]
        assert np.median(inside) == pytest.approx(place, rel=0.02)
        assert np.mean(np.abs(inside / place - 1) < 0.1) > 0.9


def test_confidence_is_where_there_is_a_picture():
    sweep = blurred.sweep(noise=0.002)
    images = np.asarray(sweep.images).copy()
    images[:, :, blurred.SPLIT :] = 1 + images[:, :, blurred.SPLIT :] * 1e-3
    dim = RefocusSweep(jnp.asarray(images), sweep.distances, sweep.slope)
    confidence = np.asarray(depth_map(dim, window=3).confidence)
    halves = blurred.halves()
    assert np.median(confidence[halves == 1]) > 0.3
    assert np.median(confidence[halves == 2]) < 0.05
    assert 0 <= confidence.min() <= confidence.max() <= 1


def test_flat_sweep_has_no_confidence_and_no_nan():
    sweep = RefocusSweep(jnp.ones((4, 9, 13)), jnp.asarray([1.0, 2.0, 3.0, 4.0]), jnp.asarray(0.1))
    depth = depth_map(sweep)
    np.testing.assert_allclose(depth.confidence, 0, atol=1e-6)
    assert np.isfinite(np.asarray(depth.distance)).all()
    np.testing.assert_allclose(all_in_focus(sweep, depth), 1, rtol=1e-12)


def test_all_in_focus_is_sharper_than_any_image_of_the_sweep():
    sweep = blurred.sweep(noise=0.002)
    picture = np.asarray(all_in_focus(sweep, depth_map(sweep)))
    halves = blurred.halves() > 0
    truth = blurred.sweep(left=100.0, right=100.0).images[0]  # all of it in focus
    errors = [
        np.linalg.norm((np.asarray(image) - np.asarray(truth))[halves])
        for image in (*sweep.images, picture)
    ]
    assert errors[-1] < 0.6 * min(errors[:-1])


def test_single_precision_and_a_batch():
    sweep = blurred.sweep(noise=0.002, batch=(2,))
    single = RefocusSweep(
        sweep.images.astype(jnp.float32),
        sweep.distances.astype(jnp.float32),
        sweep.slope.astype(jnp.float32),
    )
    depth, exact = depth_map(single), depth_map(sweep)
    assert depth.distance.dtype == jnp.float32
    assert depth.distance.shape == (2, *blurred.SHAPE)
    np.testing.assert_allclose(depth.distance[0], depth.distance[1], rtol=1e-5)
    sure = np.asarray(exact.confidence) > 0.3
    close = np.abs(np.asarray(depth.distance) - np.asarray(exact.distance))[sure] < 0.5
    assert close.mean() > 0.98
    picture = all_in_focus(single, depth)
    assert picture.dtype == jnp.float32
    assert picture.shape == (2, *blurred.SHAPE)
