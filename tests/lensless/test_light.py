"""Light over the field by sums over rays, and settings of a PSF method."""

import dataclasses
import inspect
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.lensless.field import fall_of_light, light_over_field, shading, tangents_of
from thincam_jax.lensless.method import AccuracyWarning
from thincam_jax.units import deg, nm, um

SENSOR, FIELD = tc.Sensor((24, 30), 100 * um), (50, 66)
MASK = tc.FresnelZoneAperture(25.0, 0.3, width=3.0)
DOWN, ACROSS = np.linspace(-0.5, 0.4, 7), np.linspace(-0.6, 0.7, 9)
TABLE = [[0.0, 1.0], [10 * deg, 0.95], [20 * deg, 0.7], [60 * deg, 0.1]]


def camera(**sensor):
    return tc.LenslessCamera(MASK, dataclasses.replace(SENSOR, **sensor), 6.5)


def test_the_light_falls_as_the_fourth_power_of_the_cosine():
    """A sum over a Lambertian plane's patches: solid angle of a pixel times its projection."""
    rows, columns = tangents_of(camera(), FIELD)
    y, x = rows[3], columns[60]
    to_the_point = np.array([y, x, 1.0]) * 250.0
    length = np.linalg.norm(to_the_point)
    cosine = 250.0 / length
    expected = (cosine / length**2 * cosine) * 250.0**2
    assert fall_of_light(rows, columns)[3, 60] == pytest.approx(expected, rel=1e-12)


def test_pixels_answer_by_a_power_or_a_table():
    angles = np.arctan(np.hypot(DOWN[:, None], ACROSS))
    power = light_over_field(camera(angular_response=2.5).sensor, DOWN, ACROSS)
    np.testing.assert_allclose(power, np.cos(angles) ** 6.5, rtol=1e-6)
    table = light_over_field(camera(angular_response=TABLE).sensor, DOWN, ACROSS)
    response = np.interp(angles, *np.transpose(TABLE))
    np.testing.assert_allclose(table, np.cos(angles) ** 4 * response, rtol=1e-6)


def test_the_light_of_every_point_keeps_the_psf_of_the_axis():
    """A tolerance of 1 allowed averages of few nodes, 5e-3 off behind coarse pixels."""
    image = np.zeros((9, 9))
    image[4, 4] = 1
    mask = tc.FresnelZoneAperture(25.0, width=0.9)
    coarse = tc.LenslessCamera(mask, tc.Sensor((20, 24), 60 * um), 3.0)
    scene = tc.Scene(tc.ImagePlane(image, distance=250.0, width=9 * 0.02 * 250.0), 500 * nm)
    axis = tc.capture(coarse, scene)
    light = tc.capture(coarse, scene, model=tc.PsfMethod(field_tolerance=1.0))
    shape, expected = light / jnp.sum(light), axis / jnp.sum(axis)
    np.testing.assert_allclose(shape, expected, rtol=1e-9, atol=1e-12 * float(jnp.max(expected)))


@pytest.mark.thorough
def test_captures_and_their_operators_have_the_response():
    """One point at the corner of the field, with and without; the slope in the power."""
    image = np.zeros(FIELD)
    image[0, 0] = 1
    plane = tc.ImagePlane(image, distance=250.0, width=FIELD[1] * 0.1 / 6.5 * 250.0)
    scene, model = tc.Scene(plane, 500 * nm), tc.PsfMethod(field_tolerance=1.0)

    def light(power):
        return jnp.sum(tc.capture(camera(angular_response=power), scene, model=model))

    rows, columns = tangents_of(camera(), FIELD)
    cosine = (1 + rows[-1] ** 2 + columns[-1] ** 2) ** -0.5
    even = jnp.sum(tc.capture(camera(), scene, model=model))
    value, slope = jax.value_and_grad(light)(3.0)
    np.testing.assert_allclose(value, even * cosine**3, rtol=1e-6)
    np.testing.assert_allclose(slope, value * np.log(cosine), rtol=1e-6)


def test_a_capture_of_the_axis_says_that_it_has_no_response():
    scene = tc.Scene(tc.ImagePlane(np.ones((4, 6)), 250.0, 40.0), 500 * nm)
    with pytest.warns(AccuracyWarning, match="model=PsfMethod.field_tolerance=1.0"):
        tc.capture(camera(angular_response=1.0), scene)
    with warnings.catch_warnings():
        warnings.simplefilter("error", AccuracyWarning)
        model = tc.PsfMethod(field_tolerance=1.0)
        tc.capture(camera(angular_response=1.0), scene, model=model)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (-1.0, "non-negative|>= 0"),
        ([1.0, 0.9], "shape .2,.; give one number, n of cosⁿθ, or a table"),
        ([[0.1, 1.0], [0.2, 0.9]], "angles that rise from 0"),
        ([[0.0, 1.0], [0.2, -0.9]], "responses >= 0"),
    ],
)
def test_wrong_responses(given, message):
    with pytest.raises(ValueError, match=message):
        camera(angular_response=given)


@pytest.mark.parametrize(
    ("depth", "opening", "width"), [(0.03, 0.06, None), (5.0, 4.0, 3.0), (5.0, 2.0, 3.0)]
)
def test_shading_is_the_share_of_rays(depth, opening, width):
    """Of 20000 rays an axis through what lies behind."""
    behind = opening if width is None else width
    rays = (np.arange(20000) + 0.5) / 20000 * behind - behind / 2
    passes = [np.abs(rays - depth * u[:, None]) < opening / 2 for u in (DOWN, ACROSS)]
    share = passes[0].mean(axis=1)[:, None] * passes[1].mean(axis=1)
    found = shading(DOWN, ACROSS, depth=depth, opening=opening, width=width)
    np.testing.assert_allclose(found, share, atol=2e-4)


def test_pixels_are_averaged_unless_either_says_no():
    """By default, as `capture` and `Cameras` do; a method and the function that takes it."""
    camera = tc.LenslessCamera(tc.Pinhole(0.1), tc.Sensor((6, 7), 0.05), 2.0)
    points, average = (
        tc.psf(camera, wavelength=5e-4, pixel_integration=both) for both in (False, True)
    )
    np.testing.assert_array_equal(tc.psf(camera, wavelength=5e-4), average)
    asked = tc.psf(camera, wavelength=5e-4, model=tc.PsfMethod(pixel_integration=True))
    np.testing.assert_array_equal(asked, average)
    method = tc.PsfMethod(pixel_integration=False)
    np.testing.assert_array_equal(tc.psf(camera, wavelength=5e-4, model=method), points)
    assert np.abs(points - average).max() > 0.01
    for function in (tc.psf, tc.otf, tc.mtf, tc.choose_model, tc.predict_error, tc.plot.psf):
        assert inspect.signature(function).parameters["pixel_integration"].default is True
