"""Light from outside of the field: found, named with the field that holds it, and taken in."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.imaging.targets import resize, sample_image
from thincam_jax.reconstruction.outside_light import covering, outside_light, pinned, with_field
from thincam_jax.units import nm, um

SHAPE, PITCH, DISTANCE, FAR = (64, 76), 48 * um, 3.0, 250.0
CELLS = np.random.default_rng(0).random((25, 25)) < 0.4
CAMERA = tc.LenslessCamera(
    tc.SampledMask(CELLS.astype(float), pitch=48 * um), tc.Sensor(SHAPE, PITCH), DISTANCE
)
LIGHT = {"wavelength": 550 * nm, "object_distance": FAR}
PICTURE = resize(sample_image("camera"), (64, 76))


def seen(size, snr=35.0, shading=0.0, **field):
    """A photograph `size` times as wide as the sensor's field, and the recording of its capture."""
    plane = tc.ImagePlane(PICTURE, FAR, size * SHAPE[1] * PITCH * FAR / DISTANCE)
    noise = tc.GaussianNoise(snr_db=snr)
    capture = tc.capture(CAMERA, tc.Scene(plane, 550 * nm), key=1, noise=noise)
    capture = capture * (1 + shading * jnp.sin(jnp.linspace(-2.0, 1.5, SHAPE[1])))
    return plane, tc.Recording([capture], tc.Cameras([CAMERA], **LIGHT, **field))


def likeness(result: Any, plane, shape=None):
    """Correlation with the photograph, over the middle of a shape."""
    image = np.asarray(result.image)
    truth = np.asarray(plane.sample(tc.Grid(image.shape, result.pitch), magnification=1.0))
    rows, columns = (
        slice((n - m) // 2, (n + m) // 2)
        for n, m in zip(image.shape, shape or image.shape, strict=True)
    )
    return np.corrcoef(image[rows, columns].ravel(), truth[rows, columns].ravel())[0, 1]


@pytest.mark.thorough
@pytest.mark.parametrize("solver", [tc.AdmmTV(), tc.Fista()])
def test_a_scene_beyond_a_given_field_is_said_and_the_advice_gains(solver):
    plane, recording = seen(1.0, field_shape=(44, 52))
    result: Any = tc.reconstruct(recording, solver)
    said = result.reason.partition("of the light comes from outside of the field: give ")
    share, named = float(said[0].split()[-2]), eval(said[2].partition("=")[2])
    whole, inside = plane.image, plane.sample(tc.Grid((44, 52), result.pitch), magnification=1.0)
    true = 1 - float(inside.sum() / whole.mean() / (SHAPE[0] * SHAPE[1]))
    assert abs(share / 100 - true) < 0.1
    assert all(n <= m <= n + 10 for n, m in zip(SHAPE, named, strict=True))
    followed = tc.reconstruct(with_field(recording, named), solver)
    assert followed.image.shape == named and "outside of" not in followed.reason
    assert likeness(followed, plane, (44, 52)) > 0.95 > 0.9 > likeness(result, plane)


@pytest.mark.thorough
@pytest.mark.parametrize("solver", [tc.AdmmTV(), tc.PlugAndPlay()])
def test_the_field_covers_the_scene_by_default(solver):
    """And an image of it is a start, also where nothing comes from outside."""
    plane, recording = seen(1.25)
    result: Any = tc.reconstruct(recording, solver)
    assert "the image has field_shape=" + str(result.image.shape) in result.reason
    assert all(n >= 1.2 * s for n, s in zip(result.image.shape, SHAPE, strict=True))
    kept: Any = tc.reconstruct(with_field(recording, SHAPE), solver)
    assert "give field_shape=" in kept.reason
    assert likeness(result, plane, SHAPE) > 0.9 > 0.8 > likeness(kept, plane)
    inside, short = seen(0.7)[1], dataclasses.replace(solver, iterations=10)
    again: Any = tc.reconstruct(inside, short, start=result.image)
    assert again.image.shape == result.image.shape
    within: Any = tc.reconstruct(inside, solver)
    assert within.image.shape == SHAPE and "outside" not in within.reason


@pytest.mark.thorough
@pytest.mark.parametrize("snr", [20.0, 40.0])
@pytest.mark.parametrize("shading", [0.0, 0.2])
def test_scenes_inside_have_none(snr, shading):
    """Nor does shading make some: what explains it outside is haze."""
    for size, field in ((0.7, {}), (0.8, {"field_width": 0.8 * SHAPE[1] * PITCH * FAR / DISTANCE})):
        recording = seen(size, snr, shading, **field)[1]
        for solver in (tc.AdmmTV(), tc.Ridge()):
            result = tc.reconstruct(recording, solver)
            assert "outside of" not in result.reason
            assert result.image.shape[0] == SHAPE[0]


@pytest.mark.thorough
def test_ridge_finds_it_too():
    plane, recording = seen(1.25)
    result: Any = tc.reconstruct(recording, tc.Ridge())
    assert "the image has field_shape=" + str(result.image.shape) in result.reason
    kept: Any = tc.reconstruct(with_field(recording, SHAPE), tc.Ridge())
    assert "give field_shape=" in kept.reason
    assert likeness(result, plane, SHAPE) > likeness(kept, plane) + 0.1


def test_other_models_and_starts_are_as_before():
    _, recording = seen(0.7)
    assert covering(recording, None) is covering(recording, jnp.ones(SHAPE)) is recording
    larger: Any = covering(recording, jnp.ones((3, 60, 90)))
    assert larger.imaging_model.pixels == (64, 90)
    psf = tc.Recording(np.ones((1, 24, 32)), tc.Psfs(np.ones((1, 3, 3))))
    problem = psf.problem()
    assert outside_light(psf, problem, jnp.zeros(problem.image_shape), None) is None
    assert covering(psf, jnp.ones((60, 90))) is psf is pinned(psf)
    fixed: Any = pinned(recording)
    assert fixed.imaging_model.pixels == SHAPE and pinned(larger) is larger
