"""Shots whose sensor stood elsewhere than read are found by their images; others stay as read."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.hardware.studies.images import frame_solver
from thincam_jax.hardware.studies.registration import (
    ShotPlace,
    ShotPlaces,
    read_distances,
    register_shots,
    standing_at,
)
from thincam_jax.hardware.virtual.optics import ModulatorOptics, StageErrors
from thincam_jax.imaging.metrics import align, psnr
from thincam_jax.measured.bayer import mosaic
from thincam_jax.studies.evaluate import noise_free
from thincam_jax.studies.study import Method, Study, Target
from thincam_jax.units import nm, um

WIDTH, DISTANCE = 40.0, 250.0
CENTRE, ALONG = (0.03, -0.05), 0.04  # mm, of the second shot


def blobs(shape=(52, 52)):
    random = np.random.default_rng(8)
    y, x = np.mgrid[: shape[0], : shape[1]]
    spots = [
        random.uniform(0.3, 1) * np.exp(-((y - a) ** 2 + (x - b) ** 2) / (2 * s**2))
        for a, b, s in zip(*random.uniform(4, 48, (2, 30)), random.uniform(1.0, 3, 30), strict=True)
    ]
    return np.clip(sum(spots), 0, 1)


def study():
    target = Target.of_image("blobs", blobs(), DISTANCE, WIDTH)
    scanned = tc.Exposures(40.0, [6.0, 6.6], wavelength=550 * nm, width=1.6).fringe_scanned()
    method = Method("two", scanned, tc.Wiener(), "fringe_scanning")
    sensor = tc.Sensor((80, 88), 20 * um)
    mask = tc.FresnelZoneAperture(40.0, width=1.6)
    return Study(mask, sensor, (method,), (target,), object_distance=DISTANCE, noise=None)


def frames_of(one, noise=1e-3, seed=0):
    plane, random = one.targets[0].plane, np.random.default_rng(seed)
    clean = np.stack([np.asarray(noise_free(one, e, plane))[0] for e in one.methods[0].exposures])
    return (clean + noise * clean.mean() * random.normal(size=clean.shape)).astype(np.float32)


def score(one, frames):
    image = np.squeeze(np.asarray(frame_solver(one, WIDTH)(frames).image))
    grid = tc.Grid(image.shape, one.pitch * DISTANCE / one.methods[0].distance)
    truth = np.squeeze(np.asarray(one.targets[0].plane.sample(grid, magnification=1.0)))
    return float(psnr(align(jnp.asarray(image), jnp.asarray(truth)), jnp.asarray(truth)))


FIRST, SECOND = (ShotPlace(d, d) for d in (6.0, 6.6))
MOVED = ShotPlace(6.6, 6.6 + ALONG, CENTRE)


@pytest.mark.thorough
def test_a_shot_that_stood_elsewhere_is_found():
    nominal = study()
    frames = frames_of(standing_at(nominal, ShotPlaces((FIRST, MOVED))))
    found = register_shots(nominal, frames, WIDTH)
    assert [one.status for one in found.shots] == ["reference", "moved"]
    one = found.shots[1]
    assert abs(one.distance - 6.6 - ALONG) < 3 * one.distance_error + 2e-3
    np.testing.assert_allclose(one.centre, CENTRE, atol=3 * one.centre_error + 1e-3)
    assert str(found).startswith("1 of 2 shots stood elsewhere than read, by up to ")
    assert "| 6.6000 " in str(found.table())


@pytest.mark.thorough
def test_a_shot_taken_from_its_place_gives_the_image_of_one_that_stood_right():
    nominal = study()
    frames = frames_of(standing_at(nominal, ShotPlaces((FIRST, MOVED))))
    found = register_shots(nominal, frames, WIDTH).shots[1]
    before, after, best = (
        score(standing_at(nominal, ShotPlaces((FIRST, place))), frames)
        for place in (SECOND, found, MOVED)
    )
    assert after > before + 2 and after > best - 0.4, (before, after, best)


@pytest.mark.thorough
def test_shots_that_stand_where_they_read_stay():
    nominal = study()
    found = register_shots(nominal, frames_of(nominal, seed=3), WIDTH)
    assert [one.status for one in found.shots] == ["reference", "as read"]
    assert found.shots[1] == ShotPlace(6.6, 6.6, status="as read")
    assert str(found) == "all shots stand where they are read."


@pytest.mark.thorough
def test_shots_of_nothing_but_noise_stay_and_it_is_said():
    nominal, random = study(), np.random.default_rng(1)
    found = register_shots(nominal, random.normal(10, 1, (8, 80, 88)).astype(np.float32), WIDTH)
    assert found.shots[1].distance == 6.6
    assert found.shots[1].status in ("poor_fit", "not_converged")
    assert str(found) == "1 could not be registered, and stand as read."


def test_images_of_few_pixels_are_not_registered():
    frames = np.ones((8, 80, 88), np.float32)
    found = register_shots(study(), frames, 20.0)
    assert found.shots[1] == replace(SECOND, status="too few pixels")
    assert str(found) == "1 could not be registered, and stand as read."


def test_positions_are_averaged_over_the_captures_of_a_shot():
    assert read_distances(6.5, [0.0, 0.0, 0.51, 0.53], 2) == (6.5, 7.02)


def test_exposures_have_their_own_centres():
    pair = tc.Exposures(
        25.0, [5.0, 6.0], wavelength=500 * nm, width=1.6, centre=[[0.1, 0.2], [0.0, 0.3]]
    )
    sensor, disc = tc.Sensor((8, 9), 50 * um), tc.Pinhole(0.2, centre=(0.4, 0.4))
    found = [camera.mask.centre.tolist() for camera in pair.phase_pairs().cameras(sensor)]
    np.testing.assert_allclose(found, [[0.1, 0.2]] * 2 + [[0.0, 0.3]] * 2)
    np.testing.assert_allclose(pair.cameras(sensor, disc)[1].mask.centre, [0.0, 0.3])
    without = tc.Exposures(25.0, 5.0, wavelength=500 * nm, width=1.6)
    np.testing.assert_allclose(without.cameras(sensor, disc)[0].mask.centre, [0.4, 0.4])
    with pytest.raises(ValueError, match="centre"):
        tc.Exposures(25.0, [5.0, 6.0], wavelength=500 * nm, width=1.6, centre=[[0.0, 0.1]])


def test_a_virtual_stage_errs_the_same_wherever_it_is_sent_again():
    errors = StageErrors(axial=0.02, sideways=0.03, seed=4)
    np.testing.assert_array_equal(errors.at(1.25), errors.at(1.25))
    assert not errors.at(0.0).any() and not StageErrors().at(1.0).any()
    every = np.array([errors.at(place) for place in np.arange(1.0, 2000.0).tolist()])
    np.testing.assert_allclose(every.std(axis=0), [0.02, 0.03, 0.03], rtol=0.08)


@pytest.mark.thorough
def test_a_virtual_sensor_that_stands_aside_sees_the_frame_shifted():
    """By whole pixels, but for the edges: the mask's shadow goes the other way."""
    scene = tc.Scene(tc.ImagePlane(blobs(), DISTANCE, WIDTH), 550 * nm)
    still = ModulatorOptics(scene, tc.Sensor((24, 32), 30 * um), 36 * um, 6.5, 1e5)
    errors = StageErrors(sideways=1.0)
    shift = np.array([0.0, 0.06, -0.03])
    object.__setattr__(errors, "at", lambda position: (position != 0) * shift)
    moved = replace(still, stage=errors)
    shown = np.random.default_rng(2).integers(0, 2, (16, 20)).astype(np.uint8) * 255
    first, second = (np.asarray(one(shown, 0.3)) for one in (still, moved))
    np.testing.assert_allclose(second[:-2, 1:], first[2:, :-1], rtol=2e-4)


@pytest.mark.thorough
def test_shots_of_a_mosaic_of_colours_are_found():
    """Each colour has its own light; the mean of their images is registered."""
    grey, methods = study(), []
    for number, light in enumerate((630 * nm, 532 * nm, 465 * nm)):
        scanned = tc.Exposures(40.0, [6.0, 6.6], wavelength=light, width=1.6).fringe_scanned()
        methods.append(Method(f"{number}", scanned, tc.Wiener(), "fringe_scanning"))
    plane = grey.targets[0].plane
    nominal = replace(grey, methods=tuple(methods))
    moved = standing_at(nominal, ShotPlaces((FIRST, MOVED)))
    colours = [
        [np.asarray(noise_free(moved, e, plane))[0] for e in method.exposures]
        for method in moved.methods
    ]
    frames = mosaic(np.stack(colours, axis=1), "RGGB")
    frames = frames + 1e-3 * frames.mean() * np.random.default_rng(0).normal(size=frames.shape)
    found = register_shots(nominal, frames.astype(np.float32), WIDTH, "RGGB").shots[1]
    assert found.status == "moved"
    assert abs(found.distance - 6.6 - ALONG) < 3 * found.distance_error + 2e-3
    np.testing.assert_allclose(found.centre, CENTRE, atol=3 * found.centre_error + 1e-3)
