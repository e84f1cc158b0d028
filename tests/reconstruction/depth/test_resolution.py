"""Axial resolution against direct sums over the aperture; distances evenly spaced in 1/t."""

import jax
import numpy as np
import pytest
from reconstruction.depth import rig

import thincam_jax as tc
from helpers import finite_difference
from thincam_jax.reconstruction.depth import axial_resolution, refocus_distances
from thincam_jax.units import um


def halves(t):
    """Half height and half width of the mask that the sensor sees, mm."""
    magnification = 1 + rig.DISTANCE / t
    return [min(rig.WIDTH / 2, n * rig.PITCH / 2 / magnification) for n in rig.SENSOR]


def on_axis(camera, t, focus):
    """|∫∫ exp(j(β′(t) − β′(focus))r²)| over the shadow, by direct sums, over that in focus."""
    beta, d = float(camera.mask.beta), float(camera.distance)
    curvature = [beta / (1 + d / distance) ** 2 for distance in (t, focus)]
    amplitude = 1.0
    for half in halves(t):
        x = (np.arange(4000) + 0.5) / 4000 * half * (1 + d / t)
        amplitude *= np.mean(np.exp(1j * (curvature[0] - curvature[1]) * x**2))
    return abs(amplitude)


@pytest.mark.parametrize("t", [20.0, 45.0, 130.0])
def test_an_axis_point_is_gone_one_resolution_away(t):
    camera = rig.cameras()[0]
    step = float(axial_resolution(camera, t)) / 40  # where defocus is linear in t
    # 40 times the curvature shows at a small step what β shows at the whole one.
    strong = rig.cameras(beta=40 * rig.BETA)[0]
    assert on_axis(strong, t, t + step) == pytest.approx(0.089, abs=0.015)
    assert on_axis(strong, t, t + step / 4) > 0.75


def test_reconstructed_point_fades_as_predicted():
    """Fringe scanning of a point at 20 mm, focused elsewhere; geometric shadows."""
    cams, t = rig.cameras(), 20.0
    point = np.zeros(rig.FIELD)
    point[23:25, 27:29] = 1.0
    seen = rig.captures(cams, [rig.plane(point, t)], snr_db=100.0, model="geometric")
    step = float(axial_resolution(cams[0], t))

    def brightness(focus):
        seen_by = tc.Cameras(cams, object_distance=focus, field_shape=rig.FIELD)
        found = tc.reconstruct(tc.Recording(seen, seen_by), tc.FringeScanning())
        return float(np.max(np.asarray(found.image)[22:26, 26:30]))

    sharp = brightness(t)
    # A step of a quarter of t is not small: the mean of both sides takes the asymmetry out.
    for part, low, high in ((1 / 8, 0.85, 0.95), (1 / 4, 0.6, 0.8), (1, 0.1, 0.3)):
        sides = [brightness(t + sign * part * step) for sign in (-1, 1)]
        assert low < np.mean(sides) / sharp < high


def test_only_the_part_of_the_mask_that_the_sensor_sees_counts():
    wide = tc.LenslessCamera(
        tc.FresnelZoneAperture(10.0, width=8.0), tc.Sensor((100, 160), 20 * um), 4.0
    )
    t, d = 50.0, 4.0
    magnification = 1 + d / t
    squared = ((1.0 / magnification) ** 2 + (1.6 / magnification) ** 2) / 2
    expected = np.pi * t * (t + d) / (10.0 * d * squared)
    assert float(axial_resolution(wide, t)) == pytest.approx(expected, rel=1e-12)


def test_arrays_jit_and_slope():
    camera = rig.cameras()[0]
    t = np.array([20.0, 45.0, 150.0])
    found = jax.jit(axial_resolution)(camera, t)
    squared = [np.mean(np.square(halves(distance))) for distance in t]
    closed = np.pi * t * (t + 5.0) / (rig.BETA * 5.0 * np.array(squared))
    np.testing.assert_allclose(found, closed, rtol=1e-12)

    def at(x):
        return axial_resolution(camera, x)

    slope = finite_difference(at, np.float64(45.0), np.float64(1.0), 0.5)
    assert float(jax.grad(at)(45.0)) == pytest.approx(float(slope), rel=1e-9)


def test_another_mask_is_refused():
    sampled = tc.SampledMask(np.ones((8, 8)), 20 * um)
    camera = tc.LenslessCamera(sampled, tc.Sensor((8, 8), 20 * um), 3.0)
    with pytest.raises(TypeError, match="a FresnelZoneAperture only; the camera has a SampledMask"):
        axial_resolution(camera, 20.0)


def test_distances_are_even_in_one_over_t():
    distances = np.asarray(refocus_distances(100, 220.0, 7))
    assert distances[0] == pytest.approx(100)
    assert distances[-1] == pytest.approx(220)
    np.testing.assert_allclose(np.diff(1 / distances), np.diff(1 / distances)[0], rtol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ((200.0, 100.0, 5), "is not below farthest"),
        ((0.0, 100.0, 5), "not positive"),
        ((100.0, 200.0, 1), "give at least 2"),
    ],
)
def test_bad_distances_are_refused(arguments, part):
    with pytest.raises(ValueError, match=part):
        refocus_distances(*arguments)
