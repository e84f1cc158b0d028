"""Images of a rig's frames: known pixels, mosaics, the variance of counts."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from studies import tiny
from waveguide.studies import tiny_screen

import thincam_jax as tc
from thincam_jax import AdmmTV, Ridge, Wiener
from thincam_jax import waveguide as wg
from thincam_jax.hardware.studies.images import frame_solver, live_image
from thincam_jax.hardware.studies.rig import CountingCamera, reconstruct_pictures, scenes_of
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.operators import ReducedMatrix
from thincam_jax.measured.bayer import mosaic, shifted_pattern
from thincam_jax.studies.evaluate import noise_free
from thincam_jax.studies.study import Method
from thincam_jax.units import nm
from thincam_jax.waveguide.system import monitor_system


@pytest.mark.thorough
def test_pixels_of_a_frame_that_are_not_known_are_left_out():
    """A merged frame has a lower bound where every exposure is saturated."""
    picture = replace(tiny.study().targets[1], name="grey")
    grey = replace(picture.plane, image=picture.plane.image.mean(axis=0))
    scanned = tc.Exposures(25.0, 3.0, **tiny.LIGHT).at_phases((0.0,))
    method = Method("tv", scanned, AdmmTV(tau=1.0, iterations=60), "separate", 1)
    study = tiny.study(methods=(method,), targets=(replace(picture, plane=grey),), noise=None)
    clean = np.asarray(noise_free(study, scanned[0], grey))[None]
    noise = 1e-3 * clean.mean()
    frame = clean + noise * np.random.default_rng(0).normal(size=clean.shape)
    variance = np.full(clean.shape[1:], noise**2)
    truth = np.squeeze(np.asarray(frame_solver(study, 60.0)(frame).image))
    variance[10, 10:20], frame[0, 10, 10:20] = np.inf, 0.0
    errors = [
        np.std(np.squeeze(np.asarray(frame_solver(study, 60.0, one)(frame).image)) - truth)
        for one in (variance, None)
    ]
    assert errors[0] < 0.3 * errors[1]


def coloured(solver):
    """Pairs of phases in three colours, and noisy frames of a mosaic (GRBG) of blobs in colour."""
    methods = []
    for light in (630 * nm, 532 * nm, 465 * nm):
        pairs = tc.Exposures([12.0, 10.0], 3.0, wavelength=light, width=2.0).phase_pairs()
        methods.append(Method(f"{light}", pairs, solver, "phase_pairs"))
    picture = tiny.study().targets[1]
    study = tiny.study(methods=tuple(methods), targets=(picture,), noise=None)
    light = [
        [np.asarray(noise_free(study, one, *scene.planes)) for one in method.exposures]
        for method, scene in zip(methods, scenes_of(study), strict=True)
    ]
    clean = mosaic(np.stack(light, 1), "GRBG")
    noise = 1e-3 * clean.mean() * np.random.default_rng(0).normal(size=clean.shape)
    return study, (clean + noise).astype(np.float32), np.asarray(picture.plane.image)


@pytest.mark.thorough
@pytest.mark.parametrize("solver", [Wiener(), AdmmTV(iterations=60)])
def test_mosaics_are_reconstructed_in_colour(solver):
    """Better than the mosaic read as a grey frame, and than with another pattern."""
    study, frames, truth = coloured(solver)
    grey = replace(study, methods=study.methods[1:2])
    wrong = shifted_pattern("GRBG", 1, 0)
    images = {
        "colours": frame_solver(study, 80.0, bayer="GRBG")(frames),
        "another pattern": frame_solver(study, 80.0, bayer=wrong)(frames),
        "grey": frame_solver(grey, 80.0)(frames),
    }
    scores = {}
    for name, one in images.items():
        image = np.broadcast_to(np.asarray(one.image)[:, 7:-8], (3, 45, 60))
        scores[name] = psnr(np.moveaxis(image, 0, -1), np.moveaxis(truth, 0, -1))
    assert scores["colours"] > 4 + max(scores["grey"], scores["another pattern"]), scores


@pytest.mark.thorough
def test_saturated_pixels_of_a_mosaic_are_left_out():
    """With the values that they enter, of one frame by total variation."""
    study, frames, _ = coloured(AdmmTV(iterations=30))
    shots = [
        tc.Exposures(12.0, 3.0, wavelength=m.exposures[0].wavelength, width=2.0)
        for m in study.methods
    ]
    methods = [
        replace(m, exposures=one, synthesis="separate", phases=1)
        for m, one in zip(study.methods, shots, strict=True)
    ]
    study, frame = replace(study, methods=tuple(methods)), frames[:1]
    variance = np.full(frame.shape[1:], (1e-3 * frame.mean()) ** 2)
    variance[10:12, 20:30] = np.inf
    solve = frame_solver(study, 80.0, variance, "GRBG")
    found = np.asarray(solve(frame).image)
    frame[0, 10:12, 20:30] = 1e6
    np.testing.assert_allclose(np.asarray(solve(frame).image), found, rtol=1e-3, atol=1e-3)


def test_variance_of_counts():
    """Shot noise, read noise and rounding, in counts²."""
    camera = CountingCamera(counts=1.0, electron=0.25, read_noise=2.0)
    np.testing.assert_allclose(camera.variance(np.array([0.0, 100.0])), [1 / 3, 25 + 1 / 3])


def test_a_white_monitor_is_1_where_it_is_brightest():
    study = tiny_screen.study()
    system, _ = monitor_system(study.camera, study.plane, 2)
    white = system(jnp.ones(study.plane.shape, system.values.dtype))
    assert float(jnp.max(white)) == pytest.approx(1)
    elsewhere = wg.ObjectPlane(study.plane.shape, 550.0, 120.0, (9000.0, 0.0))
    with pytest.raises(ValueError, match="no light from the monitor reaches the sensor"):
        monitor_system(study.camera, elsewhere, 2)


def test_pixels_of_a_matrix_that_are_not_known_are_left_out():
    random = np.random.default_rng(0)
    matrix = random.random((20 * 30, 8 * 9)).astype(np.float32)
    picture = random.random((8, 9))
    frame = (matrix @ picture.ravel()).reshape(20, 30) + 1e-3 * random.normal(size=(20, 30))
    variance = np.full((20, 30), 1e-6)
    variance[3, :5], frame[3, :5] = np.inf, 1e4
    solvers, known = {"ridge": Ridge()}, (matrix, ReducedMatrix.of(matrix, (8, 9)))
    found = reconstruct_pictures({"one": picture}, frame[None], known, solvers, variance)
    assert np.std(found.methods["ridge"].images[0] - picture) < 1e-3
    with pytest.raises(ValueError, match="the matrix 600 rows"):
        reconstruct_pictures({"one": picture}, frame[None, 1:], known, solvers, variance[1:])


def test_a_live_image_has_the_colours_of_the_mosaic():
    """By the first phase alone, whose background stays."""
    study, frames, truth = coloured(Wiener())
    image = live_image(study, 80.0, "GRBG")(frames[0])
    assert image.shape == (60, 60, 3)
    for colour in range(3):
        blob = np.unravel_index(truth[colour].argmax(), (45, 60))
        place = blob[0] + 7, blob[1]
        brightest = image[place[0] - 2 : place[0] + 3, place[1] - 2 : place[1] + 3].mean(
            axis=(0, 1)
        )
        assert brightest.argmax() == colour
