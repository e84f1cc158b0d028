"""The operator over the field against the PSF of each point."""

import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.imaging.operators.crop_convolution import kernel_grid
from thincam_jax.lensless.forward import imaging_operator
from thincam_jax.lensless.psf import psf_about_ray
from thincam_jax.units import nm, um

# A field of ±21° along y, ±27° along x.
SENSOR, FIELD, PITCH, DISTANCE = (24, 30), (50, 66), 100 * um, 6.5
MASK = tc.FresnelZoneAperture(25.0, 0.3, width=3.0)
CAMERA = tc.LenslessCamera(MASK, tc.Sensor(SENSOR, PITCH), DISTANCE)
# Closer averages over these coarse pixels than by default.
AVERAGED = tc.PsfMethod("separable", pixel_integration=True, nodes=55)


@pytest.fixture(scope="module")
def fit():
    return tc.field_operator(
        CAMERA, 500 * nm, object_distance=250.0, field_shape=FIELD, model=AVERAGED
    )


def captured_alone(row, column):
    """Of one point of the field, a unit of light in its sample; and the norm without the crop."""
    wide = CAMERA.on_grid(kernel_grid(CAMERA.sensor.grid, FIELD))
    seen = [(k - (n - 1) / 2) * PITCH / DISTANCE for k, n in zip((row, column), FIELD, strict=True)]
    at = tuple(-250.0 * np.array(seen))
    h = np.asarray(psf_about_ray(wide, 500 * nm, 250.0, at, AVERAGED))
    h = PITCH**2 * h * (1 + seen[0] ** 2 + seen[1] ** 2) ** -2
    return h[FIELD[0] - 1 - row :, FIELD[1] - 1 - column :][: SENSOR[0], : SENSOR[1]], h


def point(row, column):
    field = np.zeros(FIELD)
    field[row, column] = 1
    return jnp.asarray(field)


# The middle of the field, its edge and its corner, and two between the points of its grid.
@pytest.mark.parametrize("place", [(25, 33), (0, 33), (49, 65), (13, 57), (31, 5)])
@pytest.mark.thorough
def test_every_point_has_its_own_psf(fit, place):
    exact, whole = captured_alone(*place)
    error = np.linalg.norm(np.asarray(fit.operator(point(*place))) - exact)
    assert fit.truncation_error + fit.interpolation_error < 1e-2
    assert error < 1e-2 * np.linalg.norm(whole)


@pytest.mark.thorough
def test_capture_over_the_field():
    """A scene whose pixels are the field's samples, of one point at its corner."""
    image = np.zeros(FIELD)
    image[0, 0] = 1  # the object is turned on the sensor
    plane = tc.ImagePlane(image, distance=250.0, width=FIELD[1] * PITCH / DISTANCE * 250.0)
    method = tc.PsfMethod("separable", nodes=55, field_tolerance=1e-2)
    found = tc.capture(CAMERA, tc.Scene(plane, 500 * nm), model=method)
    exact, whole = captured_alone(49, 65)
    assert np.linalg.norm(np.asarray(found) - exact) < 1e-2 * np.linalg.norm(whole)


@pytest.mark.thorough
def test_a_small_field_is_a_convolution():
    """Within its tolerance, of one term, and as bright."""
    field = (11, 8)
    fit = tc.field_operator(
        CAMERA, 500 * nm, object_distance=250.0, field_shape=field, model=AVERAGED
    )
    assert fit.operator.weights.shape[0] == 1
    image = np.random.default_rng(0).uniform(size=field)
    alone = imaging_operator(CAMERA, 500 * nm, 250.0, field_shape=field)
    assert (
        relative_l2(
            np.asarray(fit.operator(jnp.asarray(image))), np.asarray(alone(jnp.asarray(image)))
        )
        < 1e-2
    )


@pytest.mark.thorough
@pytest.mark.parametrize("centre", [(0.0, 0.0), (0.4, -0.7)])
def test_cells_by_samples_at_infinity_and_two_colours(centre):
    """Masks off the axis have no mirror images; the sampled model serves every mask."""
    mask = tc.ModifiedUniformlyRedundantArray(11, cell=0.1, centre=centre)
    camera = tc.LenslessCamera(mask, tc.Sensor(SENSOR, PITCH), DISTANCE)
    method = tc.PsfMethod("angular_spectrum", oversampling=5)
    light = tc.Spectrum([500 * nm, 600 * nm], [0.5, 0.5])
    fit = tc.field_operator(camera, light, field_shape=FIELD, model=method, tolerance=0.02)
    wide = camera.on_grid(kernel_grid(camera.sensor.grid, FIELD))
    seen = (10 - 24.5) * PITCH / DISTANCE, (50 - 32.5) * PITCH / DISTANCE
    averaged = tc.PsfMethod("angular_spectrum", oversampling=5, pixel_integration=True)
    h = sum(
        0.5 * psf_about_ray(wide, w, float("inf"), (-seen[0], -seen[1]), averaged)
        for w in (500 * nm, 600 * nm)
    )
    h = np.asarray(h)[49 - 10 :, 65 - 50 :][: SENSOR[0], : SENSOR[1]]
    exact = PITCH**2 * h * (1 + seen[0] ** 2 + seen[1] ** 2) ** -2
    assert relative_l2(np.asarray(fit.operator(point(10, 50))), exact) < 0.03


def test_too_wide_a_field_says_what_to_do():
    camera = tc.LenslessCamera(
        tc.FresnelZoneAperture(100.0, width=5.0), tc.Sensor((20, 20), 0.1), 6.5
    )
    message = "21 points an axis .* give a larger tolerance or a smaller field"
    with pytest.raises(ValueError, match=message):
        tc.field_operator(camera, 500 * nm, field_shape=(400, 400), tolerance=1e-4)
