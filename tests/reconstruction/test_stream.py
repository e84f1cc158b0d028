"""Captures that follow one another."""

import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import scenes

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.imaging.operators import CropConvolution, Masked, Matrix, ReducedMatrix
from thincam_jax.imaging.operators.crop_convolution import kernel_shape

FIELD, SENSOR = (9, 12), (14, 17)
RNG = np.random.default_rng(3)


def reduced():
    return ReducedMatrix.of(RNG.normal(size=(238, 108)), FIELD)


def masked():
    kernel = scenes.spots(kernel_shape(SENSOR, FIELD))
    crop = CropConvolution(jnp.asarray(kernel), 0.5, SENSOR, FIELD)
    return Masked(crop, RNG.random(SENSOR) > 0.1)


@pytest.mark.parametrize("system", [pytest.param(reduced, marks=pytest.mark.thorough), masked])
def test_an_object_that_stands_still_is_reconstructed(system):
    """After another one, to the image that the solver alone finds; in the captures' unit."""
    system = system()
    shown, later = (jnp.asarray(scenes.blocks(FIELD)[:, ::k]) for k in (1, -1))
    solver = tc.AdmmTV(1.0, iterations=60)
    noise = 0.01 * float(jnp.std(system(shown)))
    recording = tc.Recording(system(shown), system, noise_variance=noise**2)
    stream = tc.Stream(recording, solver, steps=4)
    with pytest.raises(ValueError, match=r"captures have shapes .* the first recording's"):
        stream.next(jnp.ones((3, 5)))
    capture = 3 * system(later)
    for _ in range(60):
        stream, image = stream.next(capture)
    assert image.shape == FIELD
    alone = tc.reconstruct(
        tc.Recording(capture, system, noise_variance=noise**2),
        tc.AdmmTV(1.0, iterations=400, tolerance=1e-8),
    )
    assert relative_l2(image, alone.image) < 1e-3


def test_bad_input():
    system = Matrix(RNG.normal(size=(30, 20)), (4, 5), (5, 6))
    recording = tc.Recording(jnp.ones((5, 6)), system, noise_variance=1.0)
    with pytest.raises(ValueError, match="steps = 0: give a whole number of at least 1"):
        tc.Stream(recording, tc.AdmmTV(1.0), steps=0)
    with pytest.raises(ValueError, match="tau = 'sure' is a rule for one capture; give a number"):
        tc.Stream(recording, tc.AdmmTV("sure"))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("synthesis", "model"),
    [
        (None, "separable"),
        ([[1, -1], [1, 1]], "separable"),
        (None, tc.PsfMethod(field_tolerance=0.1)),
    ],
    ids=["captures", "contrasts", "field"],
)
def test_frames_of_cameras(synthesis, model):
    """Two phases, with computed PSFs: the upright image that the solver alone finds."""
    masks = [tc.FresnelZoneAperture(60.0, phase, width=0.5) for phase in (0.0, np.pi)]
    cameras = [tc.LenslessCamera(mask, tc.Sensor(SENSOR, 0.04), 5.0) for mask in masks]
    light = {"wavelength": 500e-6, "object_distance": 250.0}
    optics = tc.Cameras(cameras, field_shape=FIELD, model=model, **light)
    plane = tc.ImagePlane(scenes.blocks(FIELD), distance=250.0, width=20.0)
    captures = np.stack([tc.capture(c, tc.Scene(plane, 500e-6)) for c in cameras])
    solver = tc.AdmmTV(1.0, iterations=400, tolerance=1e-9, synthesis=synthesis)
    first = tc.Recording(captures, optics, noise_variance=1e-5)
    stream = tc.Stream(first, solver, steps=10)
    for _ in range(30):
        stream, image = stream.next([1.5 * captures[0], 1.5 * captures[1]])
    alone = tc.reconstruct(tc.Recording(1.5 * captures, optics, noise_variance=1e-5), solver)
    assert relative_l2(image, alone.image) < 1e-3


def test_captures_of_nan_are_refused():
    """Not where they are not valid."""
    psf, capture = np.random.default_rng(0).random((5, 5)), np.ones((1, 12, 16))
    broken = capture.copy()
    broken[0, 2, 3] = np.nan
    for valid in (None, np.isfinite(broken)):
        recording = tc.Recording(capture, tc.Psfs(psf[None]), noise_variance=0.01, valid=valid)
        stream = tc.Stream(recording, tc.AdmmTV(0.5, iterations=10), steps=1)
        if valid is None:
            with pytest.raises(ValueError, match=r"captures\[0\] holds NaN .* with valid="):
                stream.next(broken)
        else:
            assert np.isfinite(stream.next(broken)[1]).all()
