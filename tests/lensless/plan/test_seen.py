"""How much of a capture the sensor catches, against an explicit convolution."""

import numpy as np
import pytest
import scipy.signal

import thincam_jax as tc
from thincam_jax.lensless.plan.seen import crop_factor


@pytest.mark.parametrize("width", [1.0, 2.5, 9.0])
@pytest.mark.parametrize("shape", [(40, 61), (90, 30)])
def test_factor_is_that_of_a_box_convolution(width, shape):
    pitch, distance = 0.05, 130.0
    mask = tc.FresnelZoneAperture(25.0, width=width)
    camera = tc.LenslessCamera(mask, tc.Sensor(shape, pitch), 6.5)
    image = np.random.default_rng(0).uniform(size=(1, 25, 33))
    image[:, 8:] *= 3
    scale = 1 + 6.5 / distance
    kernel = [s + f - 1 for s, f in zip(shape, image.shape[1:], strict=True)]
    inside = [np.abs(np.arange(k) - (k - 1) / 2) * pitch <= width * scale / 2 for k in kernel]
    whole = scipy.signal.fftconvolve(image[0], np.outer(*inside).astype(float))
    rows, columns = (f - 1 for f in image.shape[1:])
    caught = whole[rows : rows + shape[0], columns : columns + shape[1]]
    expected = np.linalg.norm(whole) / np.linalg.norm(caught)
    assert crop_factor(camera, distance, image) == pytest.approx(expected, rel=0.05)


def test_a_sensor_that_sees_nothing_has_no_factor():
    """The shadow falls beside the kernel's grid."""
    mask = tc.FresnelZoneAperture(25.0, width=1.0, centre=(50.0, 0.0))
    camera = tc.LenslessCamera(mask, tc.Sensor((10, 12), 0.05), 6.5)
    assert crop_factor(camera, 250.0, np.ones((1, 4, 5))) == np.inf
