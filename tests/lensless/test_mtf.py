"""Contrast over frequency: a square in closed form, and its value under jit, grad and vmap."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import finite_difference, quick
from thincam_jax.units import nm, um

RHO = np.array([0.0, 0.7, 2.3, 6.1])


def contrast(beta, frequencies=RHO, model="geometric"):
    mask = tc.FresnelZoneAperture(beta, 0.4, width=1.0)
    camera = tc.LenslessCamera(mask, tc.Sensor((36, 44), 40 * um), distance=5.0)
    light = {"wavelength": 500 * nm, "object_distance": 250.0, "model": model}
    return tc.mtf(camera, **light, frequencies=frequencies)


def test_of_a_square_opening():
    """Its shadow, of M times its side, and the pixels: products of sincs along both axes."""
    side, pitch, magnification = 0.9, 30 * um, 1 + 5 / 200
    opening = tc.SeparableMask(np.ones(3), np.ones(3), side / 3)
    camera = tc.LenslessCamera(opening, tc.Sensor((40, 52), pitch), distance=5.0)
    light = {"wavelength": 500 * nm, "object_distance": 200.0, "model": "geometric"}
    theta = np.linspace(0, np.pi, 2000, endpoint=False)
    along = RHO[:, None] * np.sin(theta), RHO[:, None] * np.cos(theta)
    for average, width in ((True, pitch), (False, 0.0)):
        by_axis = [np.sinc(magnification * side * u) * np.sinc(width * u) for u in along]
        expected = np.sqrt(np.mean(np.prod(by_axis, axis=0) ** 2, axis=1))
        found = tc.mtf(camera, **light, frequencies=RHO, pixel_integration=average)
        # Values at the centres of pixels have the edges half a pixel off at most.
        np.testing.assert_allclose(found, expected, atol=1e-3 if average else 3e-2)
    whole = tc.mtf(camera, **light)
    assert whole.shape == (64,) and whole[0] == pytest.approx(1.0)


@pytest.mark.parametrize("model", quick(("geometric", "separable", "angular_spectrum"), 2))
def test_under_jit_grad_and_vmap(model):
    def at(beta):
        return contrast(beta, model=model)[2]

    found, slope = jax.jit(jax.value_and_grad(at))(25.0)
    np.testing.assert_allclose(
        slope, finite_difference(at, jnp.asarray(25.0), 1.0, 1e-2), rtol=1e-6
    )
    several = jax.vmap(at)(jnp.asarray([25.0, 20.0]))
    np.testing.assert_allclose(several, [found, at(20.0)], rtol=1e-6)


def test_frequencies_beyond_the_pixels_are_refused():
    with pytest.raises(ValueError, match=r"frequencies\) = 13.0 .*give 0 to 12.5 cycles/mm"):
        contrast(25.0, np.array([1.0, -13.0]))
    contrast(25.0, np.array([12.5]))
