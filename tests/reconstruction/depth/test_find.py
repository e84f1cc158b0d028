"""Distances of objects and of every pixel, and measures of focus."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage as ndimage
from reconstruction.depth import blurred, rig

import thincam_jax as tc
from helpers import count_traces, finite_difference, quick
from thincam_jax.reconstruction import fringe_scanning
from thincam_jax.reconstruction.depth.find import (
    MEASURES,
    all_in_focus,
    depth_map,
    depth_of_colours,
    find_distances,
    focus_measure,
    gaussian_average,
    object_regions,
    vertex,
)
from thincam_jax.reconstruction.depth.refocus import RefocusSweep, refocus_distances, refocus_sweep


@pytest.mark.parametrize("measure", MEASURES)
def test_two_textures_are_found_between_the_steps(measure):
    """Steps are 5 to 12 mm; without optics nothing pulls the maximum away from the focus."""
    found = find_distances(blurred.sweep(), measure=measure, regions=blurred.halves())
    assert found.labels == (1, 2)
    assert found.curves.shape == (2, 15)
    for region, place in ((1, blurred.LEFT), (2, blurred.RIGHT)):
        peak = found.distance_of(region)
        assert peak.distance == pytest.approx(place, rel=0.01)
        assert not peak.at_end
        assert 0.05 < peak.contrast < 1


def test_focus_outside_of_the_sweep_is_told():
    found = find_distances(blurred.sweep(right=300.0), regions=blurred.halves())
    peak = found.distance_of(2)
    assert peak.at_end
    assert peak.distance == pytest.approx(220.0)
    assert not found.distance_of(1).at_end


def test_whole_field_shows_both_where_they_are_far_apart():
    found = find_distances(blurred.sweep(left=108.0, right=190.0, blur=5000.0))
    assert [p.region for p in found.peaks] == [1, 1]
    np.testing.assert_allclose(sorted(p.distance for p in found.peaks), [108, 190], rtol=0.03)


def test_vertex_of_a_parabola_over_one_over_t_is_exact():
    distances = np.array([100.0, 111.0, 150.0])  # uneven, over t and over 1/t
    for place in (103.0, 111.0, 120.0):
        curve = 2.0 - 3e4 * (1 / distances - 1 / place) ** 2
        assert vertex(curve, distances, 1) == pytest.approx(place, rel=1e-9)


def test_regions_are_the_bright_objects_from_left_to_right():
    image = np.zeros((60, 100))
    image[10:40, 60:90] = 1
    image[25:50, 8:35] = 0.6
    image[3:5, 45:47] = 1  # too small
    stack = jnp.asarray(np.stack([image] * 3))
    sweep = RefocusSweep(stack, jnp.asarray([1.0, 2.0, 3.0]), jnp.asarray(0.1))
    regions = object_regions(sweep)
    assert set(np.unique(regions)) == {0, 1, 2}
    assert (regions[25:50, 8:35] == 1).all()
    assert (regions[10:40, 60:90] == 2).all()
    assert (regions > 0).mean() < 0.4
    for label, middle in ((1, (37, 21)), (2, (24.5, 74.5))):
        found = np.mean(np.nonzero(regions == label), axis=1)
        np.testing.assert_allclose(found, middle, atol=1.5)
    assert not object_regions(sweep, least=5000).any()


@pytest.mark.thorough
def test_objects_before_a_camera_are_found():
    """Two chequered boxes at 20 and 45 mm, 30 dB: to 5 %, with regions found by themselves."""
    cams = rig.cameras()
    boxes = ((slice(12, 36), slice(4, 22)), (slice(10, 34), slice(34, 52)))
    planes = [rig.plane(rig.checks(b), t) for b, t in zip(boxes, (20.0, 45.0), strict=True)]
    seen = rig.captures(cams, planes)
    variance = float(np.mean(np.asarray(seen) ** 2)) * 1e-3
    recording = tc.Recording(seen, rig.imaging_model(cams), noise_variance=variance)
    wiener = tc.Wiener(synthesis=fringe_scanning(1))
    sweep = refocus_sweep(recording, refocus_distances(15.0, 90.0, 16), wiener)
    regions = object_regions(sweep)
    assert regions.max() == 2
    found = find_distances(sweep, regions=regions)
    assert found.distance_of(1).distance == pytest.approx(20, rel=0.05)
    assert found.distance_of(2).distance == pytest.approx(45, rel=0.05)


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


def picture(shape=(31, 44), seed=1):
    rng = np.random.default_rng(seed)
    return ndimage.gaussian_filter(rng.normal(size=shape), 1.5) + 0.3


def plain(image, measure, region):
    """The measures in SciPy's words, without smoothing."""
    if measure == "laplacian_variance":
        return ndimage.laplace(image, mode="nearest")[region].var()
    slopes = [ndimage.sobel(image, axis, mode="nearest") / 8 for axis in (0, 1)]
    length = np.hypot(*slopes)[region]
    if measure == "gradient_energy":
        return np.mean(length**2)
    return np.sqrt(np.mean(length**2)) / np.mean(length)


@pytest.mark.parametrize("measure", MEASURES)
def test_values_are_those_of_scipy(measure):
    image = picture()
    region = np.zeros(image.shape, bool)
    region[:19, 7:] = True
    whole = np.ones(image.shape, bool)
    expected = plain(image, measure, whole)
    assert float(focus_measure(image, measure, smoothing=0)) == pytest.approx(expected, rel=1e-10)
    part = focus_measure(image, measure, smoothing=0, region=region)
    assert float(part) == pytest.approx(plain(image, measure, region), rel=1e-10)
    assert float(part) != pytest.approx(expected, rel=1e-3)


def test_gaussian_average_is_scipys_inside_and_keeps_constants():
    image = picture((60, 71))
    inner = (slice(16, -16), slice(16, -16))
    found = np.asarray(gaussian_average(jnp.asarray(image), 2.5))
    expected = ndimage.gaussian_filter(image, 2.5, truncate=6)
    np.testing.assert_allclose(found[inner], expected[inner], rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(gaussian_average(jnp.full((9, 14), 0.7), 3), 0.7, rtol=1e-12)


@pytest.mark.parametrize("measure", MEASURES)
def test_map_is_large_where_the_picture_is_sharp(measure):
    """The left half in focus, the right half blurred; the map's mean weights make the number."""
    rng = np.random.default_rng(3)
    sharp = (ndimage.gaussian_filter(rng.normal(size=(40, 81)), 2) > 0).astype(float)
    blurred = ndimage.gaussian_filter(sharp, 2)
    image = np.where(np.arange(81) < 40, sharp, blurred)
    values = np.asarray(focus_measure(image, measure, smoothing=0.5, window=4.0))
    assert values.shape == image.shape
    assert np.median(values[:, :30]) > 1.2 * np.median(values[:, 52:])


@pytest.mark.parametrize("measure", MEASURES)
def test_blur_lowers_every_measure(measure):
    sharp = np.zeros((40, 53))
    sharp[10:28, 12:30] = 1
    blurred = ndimage.gaussian_filter(sharp, 2)
    assert float(focus_measure(sharp, measure)) > 1.1 * float(focus_measure(blurred, measure))


def test_sparsity_is_free_of_scale_and_one_for_nothing():
    image = picture()
    first = focus_measure(image, "gradient_sparsity")
    assert float(focus_measure(7.3 * image + 2, "gradient_sparsity")) == pytest.approx(float(first))
    assert float(focus_measure(np.full((9, 12), 0.5), "gradient_sparsity", smoothing=0)) == 1


@pytest.mark.parametrize("measure", quick(MEASURES, 1))
def test_slope_jit_and_batch(measure):
    images = jnp.stack([jnp.asarray(picture(seed=s)) for s in (1, 2)])
    counted = count_traces(lambda image: focus_measure(image, measure))
    compiled = jax.jit(counted)
    each = [float(compiled(image)) for image in images]
    assert counted.traces == 1
    np.testing.assert_allclose(focus_measure(images, measure), each, rtol=1e-10)
    mapped = jax.vmap(lambda image: focus_measure(image, measure, window=3.0))(images)
    np.testing.assert_allclose(mapped, focus_measure(images, measure, window=3.0), rtol=1e-10)
    direction = jnp.asarray(picture(seed=5))
    slope = finite_difference(compiled, images[0], direction, 1e-3)
    gradient = jax.jit(jax.grad(lambda i: focus_measure(i, measure)))
    found = np.sum(gradient(images[0]) * direction)
    assert float(found) == pytest.approx(float(slope), rel=1e-6)


def test_colours_share_one_depth_map():
    images = np.random.default_rng(0).normal(size=(3, 1, 12, 14)).astype(np.float32)
    colours = jnp.asarray(np.concatenate([images, 2 * images, -images], axis=1))
    _, depth, sharp = depth_of_colours(colours, (60.0, 80.0, 120.0))
    assert depth.distance.shape == (12, 14)
    np.testing.assert_allclose(sharp[1:], np.stack([2 * sharp[0], -sharp[0]]), atol=1e-6)
