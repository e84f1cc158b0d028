"""Distances: of blurred textures, whose focus is known, and of objects before a camera."""

import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction.depth import blurred, rig
from reconstruction.rig import unchecked

import thincam_jax as tc
from thincam_jax.reconstruction import fringe_scanning
from thincam_jax.reconstruction.depth import (
    MEASURES,
    RefocusSweep,
    find_distances,
    object_regions,
    refocus_distances,
    refocus_sweep,
)
from thincam_jax.reconstruction.depth.find import vertex


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


def test_channels_of_a_batch_are_averaged():
    one = find_distances(blurred.sweep(), regions=blurred.halves())
    three = find_distances(blurred.sweep(batch=(3,)), regions=blurred.halves())
    np.testing.assert_allclose(three.curves, one.curves, rtol=1e-10)


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
    recording = tc.Recording(seen, rig.seen_by(cams), noise_variance=variance)
    wiener = tc.Wiener(synthesis=fringe_scanning(1))
    sweep = refocus_sweep(recording, refocus_distances(15.0, 90.0, 16), wiener)
    regions = object_regions(sweep)
    assert regions.max() == 2
    found = find_distances(sweep, regions=regions)
    assert found.distance_of(1).distance == pytest.approx(20, rel=0.05)
    assert found.distance_of(2).distance == pytest.approx(45, rel=0.05)


@pytest.mark.parametrize(
    ("regions", "part"),
    [(np.zeros(blurred.SHAPE, int), "no label above 0"), (np.ones((4, 5), int), "of \\(48, 90\\)")],
)
def test_bad_regions_are_refused(regions, part):
    with unchecked(), pytest.raises(ValueError, match=part):
        find_distances(blurred.sweep(), regions=regions)
