"""Sweeps of the focus, and the axial resolution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from reconstruction.depth import rig
from reconstruction.rig import refused

import thincam_jax as tc
from helpers import finite_difference
from thincam_jax.reconstruction import fringe_scanning
from thincam_jax.reconstruction.depth.find import depth_map, find_distances
from thincam_jax.reconstruction.depth.refocus import axial_resolution, refocus_sweep
from thincam_jax.reconstruction.noise import estimate_variance
from thincam_jax.units import um

DISTANCES = (18.0, 20.0, 24.0, 45.0)


@pytest.fixture(scope="module")
def recording():
    cams = rig.cameras()
    planes = [
        rig.plane(rig.checks((slice(10, 34), slice(4, 22))), 20.0),
        rig.plane(rig.checks((slice(10, 34), slice(34, 52))), 45.0),
    ]
    return tc.Recording(rig.captures(cams, planes), rig.imaging_model(cams), noise_variance=1e-4)


SYNTHESIS = fringe_scanning(1)
SOLVERS = {
    "fringe_scanning": tc.FringeScanning(),
    "wiener": tc.Wiener(synthesis=SYNTHESIS),
    "admm_tv": tc.AdmmTV(1.0, synthesis=SYNTHESIS, iterations=10),
}


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["fringe_scanning", "wiener", "admm_tv"])
def test_images_are_those_of_reconstruct(recording, name):
    solver, done = SOLVERS[name], []
    sweep = refocus_sweep(recording, DISTANCES[:3], solver, callback=done.append)
    assert done == [1, 2, 3]
    assert sweep.method == name
    focused = rig.imaging_model(recording.imaging_model.cameras, object_distance=DISTANCES[1])
    alone = tc.reconstruct(tc.Recording(recording.captures, focused, noise_variance=1e-4), solver)
    np.testing.assert_allclose(sweep.images[1], alone.image, rtol=1e-9, atol=1e-9)
    assert not np.allclose(sweep.images[0], sweep.images[2], atol=1e-3)
    assert float(sweep.slope) == pytest.approx(rig.PITCH / rig.DISTANCE)
    np.testing.assert_allclose(sweep.pitch, np.array(DISTANCES[:3]) * rig.PITCH / rig.DISTANCE)


def test_a_direction_stays_where_it_is(recording):
    """Both boxes, at 20 and 45 mm, cover the same pixels whatever the focus."""
    sweep = refocus_sweep(recording, DISTANCES, tc.FringeScanning())
    for image in np.asarray(sweep.images):
        for columns in (slice(0, 28), slice(28, 56)):
            light = np.maximum(image[:, columns] - 0.25 * image.max(), 0)
            rows, across = light.sum(1), light.sum(0)
            middle = rows @ np.arange(48) / rows.sum(), across @ np.arange(28) / across.sum()
            wanted = (21.5, 12.5 if columns.start == 0 else 14.5)
            np.testing.assert_allclose(middle, wanted, atol=0.8)


def test_the_noise_of_all_images_is_that_of_the_captures(recording):
    cams, captures = recording.imaging_model, recording.captures
    wiener = SOLVERS["wiener"]
    told = tc.Recording(captures, cams, noise_variance=estimate_variance(captures))
    estimated = refocus_sweep(tc.Recording(captures, cams), DISTANCES[:3], wiener)
    known = refocus_sweep(told, DISTANCES[:3], wiener)
    np.testing.assert_allclose(estimated.images, known.images, rtol=1e-9, atol=1e-9)


def test_what_has_no_distance_and_what_does_not_compare_is_refused(recording):
    psfs = tc.Recording(jnp.ones((1, 20, 21)), tc.Psfs(jnp.ones((1, 5, 6))))
    message = r"the PSFs have 1 planes, .* for 4 distances; give one for each"
    refused(message, lambda: refocus_sweep(psfs, DISTANCES))
    refused("only Cameras can be focused", lambda: psfs.focused(20.0))
    message = "tau = 'sure' would be another number at each distance"
    refused(message, lambda: refocus_sweep(recording, DISTANCES, tc.AdmmTV("sure")))


def spots(scale, shape=(48, 64)):
    """A diffuser's PSF; it grows as the point comes nearer."""
    generator = np.random.default_rng(4)
    centres = generator.uniform(-0.38, 0.38, (60, 2)) * shape * scale
    y, x = (np.arange(n)[:, None] - (n - 1) / 2 for n in shape)
    rows, columns = (np.exp(-((a - c) ** 2) / 2) for a, c in zip((y, x), centres.T, strict=True))
    psf = rows @ columns.T
    return psf / psf.sum()


@pytest.mark.thorough
def test_measured_psfs_tell_the_distances():
    """Two chequered boxes, each seen through the PSF measured at its distance."""
    distances = (12.0, 16.0, 24.0, 48.0)
    psfs = np.stack([spots(1 + 3 / t) for t in distances])
    capture = np.zeros((48, 64))
    boxes = (slice(14, 34), slice(8, 26)), (slice(14, 34), slice(38, 56))
    for box, plane in zip(boxes, (1, 2), strict=True):
        image = np.zeros((95, 127))
        image[23:71, 31:95][box] = np.kron(np.indices((5, 6)).sum(0) % 2, np.ones((4, 3)))
        whole = scipy.signal.fftconvolve(image, psfs[plane])
        capture += whole[47:95, 63:127]
    capture += 1e-4 * np.random.default_rng(5).normal(size=capture.shape)
    recording = tc.Recording(capture[None], tc.Psfs(psfs[None, None]))
    sweep = refocus_sweep(recording, distances, tc.AdmmTV(iterations=60))
    assert sweep.slope is None and sweep.pitch is None
    alone = tc.reconstruct(
        tc.Recording(
            capture[None],
            tc.Psfs(psfs[None, 2]),
            noise_variance=estimate_variance(jnp.asarray(capture[None])),
        ),
        tc.AdmmTV(iterations=60),
    )
    np.testing.assert_allclose(sweep.images[2], alone.image, rtol=1e-9, atol=1e-9)
    regions = np.zeros(capture.shape, int)
    for label, box in enumerate(boxes, start=1):
        regions[box] = label
    found = find_distances(sweep, regions=regions)
    assert [round(found.distance_of(n).distance) for n in (1, 2)] == pytest.approx([16, 24], abs=2)
    depth = depth_map(sweep)
    for box, wanted in zip(boxes, (16, 24), strict=True):
        assert np.median(depth.distance[box]) == pytest.approx(wanted, abs=2)


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
    step = float(axial_resolution(camera, object_distance=t)) / 40  # where defocus is linear in t
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
    step = float(axial_resolution(cams[0], object_distance=t))

    def brightness(focus):
        imaging_model = tc.Cameras(cams, object_distance=focus, field_shape=rig.FIELD)
        found = tc.reconstruct(tc.Recording(seen, imaging_model), tc.FringeScanning())
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
    assert float(axial_resolution(wide, object_distance=t)) == pytest.approx(expected, rel=1e-12)


def test_arrays_jit_and_slope():
    camera = rig.cameras()[0]
    t = np.array([20.0, 45.0, 150.0])
    found = jax.jit(axial_resolution)(camera, object_distance=t)
    squared = [np.mean(np.square(halves(distance))) for distance in t]
    closed = np.pi * t * (t + 5.0) / (rig.BETA * 5.0 * np.array(squared))
    np.testing.assert_allclose(found, closed, rtol=1e-12)

    def at(x):
        return axial_resolution(camera, object_distance=x)

    slope = finite_difference(at, np.float64(45.0), np.float64(1.0), 0.5)
    assert float(jax.grad(at)(45.0)) == pytest.approx(float(slope), rel=1e-9)


def test_another_mask_is_refused():
    sampled = tc.SampledMask(np.ones((8, 8)), 20 * um)
    camera = tc.LenslessCamera(sampled, tc.Sensor((8, 8), 20 * um), 3.0)
    with pytest.raises(TypeError, match="a FresnelZoneAperture only; the camera has a SampledMask"):
        axial_resolution(camera, object_distance=20.0)
