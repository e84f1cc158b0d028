"""`PsfMethod`: what it refuses, and the defaults that a mask and a grid give it."""

import inspect

import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.lensless.method import psf_method


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"model": "exact"}, "^model = 'exact' is unknown; choose one of 'geometric'"),
        *(
            ({"precision": name}, r"^precision = .* is unknown; choose one of 'float32'")
            for name in ("half", "float16", "double", 64)
        ),
        ({"oversampling": 3}, "'separable' is a closed form: leave oversampling"),
        ({"oversampling": 4, "model": "angular_spectrum"}, "oversampling = 4: give an odd number"),
        ({"oversampling": 0, "model": "angular_spectrum"}, "oversampling = 0: give a whole number"),
        ({"oversampling": -1, "model": "rayleigh_sommerfeld"}, "oversampling = -1: give a whole"),
        ({"mask_shape": (3, 0), "model": "angular_spectrum"}, "mask_shape = .* of at least 1"),
    ],
)
def test_settings_that_are_refused(settings, message):
    """By its own check: that of the annotations, on in the tests, is taken off."""
    with pytest.raises(ValueError, match=message) as error:
        tc.PsfMethod.__init__.__wrapped__(object.__new__(tc.PsfMethod), **settings)
    assert "\n" not in str(error.value)


def test_defaults_follow_from_mask_and_grid():
    mask, grid = tc.Pinhole(0.5), tc.Grid((32, 48), np.float32(0.02))
    assert psf_method(mask, grid, "separable") == tc.PsfMethod("separable", "float32", True)
    found = psf_method(mask, grid, "angular_spectrum")
    assert found == tc.PsfMethod("angular_spectrum", "float32", True, 3, (25, 25))
    assert psf_method(mask, grid, found) == found
    points = tc.PsfMethod("angular_spectrum", "float64", pixel_integration=False)
    assert psf_method(mask, grid, points).samples == 1


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
