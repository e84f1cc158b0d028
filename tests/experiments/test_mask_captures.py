"""Captures of masks in equal light, and the linear estimate of these."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tools import mask_captures as captures

import thincam_jax as tc
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import kernel_shape
from thincam_jax.units import um


@pytest.mark.thorough
def test_light_is_that_of_the_bare_sensor():
    """A white scene through a PSF of one over the field's shadow: the electrons asked for, and
    captures that share it have their parts."""
    field, plate = (24, 28), tc.FresnelZoneAperture(100.0, width=0.744)
    setting = captures.Setting(tc.Sensor((48, 56), 24 * um), 2.0, field, 0.744)
    whole = kernel_shape(setting.sensor.shape, field)
    white, key = jnp.ones((1, *field)), jax.random.key(0)
    one = captures.ComparedMask((plate,))
    four = captures.ComparedMask(4 * (plate,), synthesis="fringe_scanning")
    seen = captures.capture(setting, one, jnp.ones((1, *whole)), white, 1e4, key)
    area = np.prod(field) * setting.pitch**2
    electrons = np.asarray(seen.channels[0, 0]) / area * 1e4
    np.testing.assert_allclose(electrons.mean(), 1e4, rtol=1e-3)
    np.testing.assert_allclose(electrons.var(), 1e4 + 9, rtol=0.1)
    np.testing.assert_allclose(seen.variance * (1e4 / area) ** 2, 1e4 + 9, rtol=1e-3)
    # Differences of two of four captures, each of a quarter of the light.
    seen = captures.capture(setting, four, jnp.ones((4, *whole)), white, 1e4, key)
    expected = 2 * (2500 + 9) * (area / 2500) ** 2
    np.testing.assert_allclose(seen.variance, expected, rtol=1e-3)
    np.testing.assert_allclose(np.var(seen.channels), expected, rtol=0.1)
    np.testing.assert_allclose(seen.level, 1, rtol=0.01)  # which the differences do not tell


def test_linear_estimate_solves_its_equation(key):
    """Against the dense normal equations, of two cameras whose PSFs reach beyond the sensor."""
    shape, field = (9, 12), (7, 8)
    whole = kernel_shape(shape, field)
    kernels = jax.random.uniform(key, (2, *whole))
    cameras = [CropConvolution(h[None], 0.1, shape, field) for h in kernels]
    images = jax.random.uniform(key, (1, *field))
    channels = jnp.stack([camera(images[:, None])[:, 0] for camera in cameras], axis=1)
    variance, (a, b) = jnp.array([1e-3]), (3.0, 0.2)
    found = captures.best_linear(
        cameras, captures.Seen(channels, variance, jnp.array([0.4])), jnp.array([[a, b]])
    )
    units = jnp.eye(56).reshape(56, 1, *field)
    matrix = np.concatenate([np.asarray(c(units)).reshape(56, -1).T for c in cameras])
    basis = np.eye(56).reshape(56, *field)
    rough = np.concatenate([np.diff(basis, axis=n).reshape(56, -1).T for n in (1, 2)])
    uniform, g = matrix.sum(axis=1), np.asarray(channels).reshape(2, -1).ravel()
    normal = matrix.T @ matrix / 1e-3 + a * rough.T @ rough + b * np.eye(56)
    expected = np.linalg.solve(normal, matrix.T @ (g - 0.4 * uniform) / 1e-3) + 0.4
    np.testing.assert_allclose(found.ravel(), expected, atol=0.01)
