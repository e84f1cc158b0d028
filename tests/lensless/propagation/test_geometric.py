"""The shadow: what every wave model tends to as λ → 0, its pixel averages and its edge."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lensless.propagation import reference

import thincam_jax as tc
from helpers import finite_difference

BETA, PHASE, CENTRE = 30.0, 0.6, (0.05, -0.12)


def psf_of(shape, pitch, *, model="geometric", wavelength=500e-6, average=False, t=20.0, **mask):
    mask = {"width": 1.0, "centre": CENTRE} | mask
    camera = tc.LenslessCamera(
        tc.FresnelZoneAperture(BETA, PHASE, **mask), tc.Sensor(shape, pitch), 5.0
    )
    return np.asarray(
        tc.psf(
            camera, wavelength=wavelength, object_distance=t, model=model, pixel_integration=average
        )
    )


def shadow(y, x, width=1.0, t=20.0, height=1.0):
    """|t(r/M)|² (Eq 3.3 corrected: the shadow is the larger), M = 1 + d/t."""
    m = 1 + 5.0 / t
    y, x = (y / m - CENTRE[0])[:, None], x / m - CENTRE[1]
    inside = (np.abs(y) <= height / 2) & (np.abs(x) <= width / 2)
    return inside * (0.5 * (1 + np.cos(BETA * (x**2 + y**2) + PHASE))) ** 2


@pytest.mark.parametrize(("shape", "t"), [((40, 53), 20.0), ((40, 53), np.inf), ((1, 1), 20.0)])
def test_is_the_magnified_mask(shape, t):
    y, x = (reference.centred(n, 0.031) for n in shape)
    expected = shadow(y, x, t=t)
    np.testing.assert_allclose(psf_of(shape, 0.031, t=t), expected, rtol=0, atol=1e-13)


@pytest.mark.thorough
def test_rectangle():
    """Its points, and the means of its pixels, those at the edges too, by sampling them."""
    y, x = (reference.centred(n, 0.031) for n in (40, 53))
    sides = {"width": 1.0, "height": 0.6}
    found = psf_of((40, 53), 0.031, **sides)
    np.testing.assert_allclose(found, shadow(y, x, **sides), rtol=0, atol=1e-13)
    y, x = (reference.centred(15 * n, 0.031 / 15) for n in (40, 53))
    average = shadow(y, x, **sides).reshape(40, 15, 53, 15).mean(axis=(1, 3))
    found = psf_of((40, 53), 0.031, average=True, **sides)
    np.testing.assert_allclose(found, average, rtol=0, atol=0.05)
    assert np.abs(found - average).mean() < 2e-3


def test_binary_profile():
    """|Σ c_k e^{jk(βr²+φ)}|² of the truncated series itself, zone by zone."""
    y, x = (reference.centred(n, 0.031) for n in (20, 27))
    m = 1.25
    r2 = (y / m - CENTRE[0])[:, None] ** 2 + (x / m - CENTRE[1]) ** 2
    angle = BETA * r2 + PHASE
    series = 0.5 + sum(
        2 * np.sin(k * np.pi / 2) / (k * np.pi) * np.cos(k * angle) for k in (1, 3, 5, 7)
    )
    value = psf_of((20, 27), 0.031, profile="binary", harmonics=7)
    np.testing.assert_allclose(value, series**2, rtol=0, atol=1e-13)
    # Away from the zone edges the series is the open or closed mask.
    clear = np.abs(np.cos(angle)) > 0.6
    assert np.abs(value - (np.cos(angle) > 0))[clear].max() < 0.25


def test_intensity_profile():
    """The shadow of √I is I, up to the harmonics that are left out."""
    y, x = (reference.centred(n, 0.031) for n in (20, 27))
    r2 = (y / 1.25 - CENTRE[0])[:, None] ** 2 + (x / 1.25 - CENTRE[1]) ** 2
    value = psf_of((20, 27), 0.031, profile="intensity", harmonics=9)
    np.testing.assert_allclose(value, 0.5 * (1 + np.cos(BETA * r2 + PHASE)), rtol=0, atol=8e-3)


def test_display_pixels():
    """10×10 pixels of 0.1 mm, half open: constant inside, dark between; the average is exact."""
    pixel, fill, m = 0.1, 0.49, 1.25
    sites = reference.centred(10, pixel)
    shown = (0.5 * (1 + np.cos(BETA * (sites[:, None] ** 2 + sites**2) + PHASE))) ** 2
    mask = {"pixel_pitch": pixel, "fill_factor": fill, "centre": (0.0, 0.0)}
    at_sites = psf_of((10, 10), pixel * m, **mask)
    np.testing.assert_allclose(at_sites, shown, rtol=0, atol=1e-13)
    averages = psf_of((10, 10), pixel * m, average=True, **mask)
    np.testing.assert_allclose(averages, shown * fill, rtol=0, atol=1e-13)
    between = psf_of((11, 9), pixel * m, **mask)  # odd against even: between display rows
    assert np.abs(between).max() == 0.0


@pytest.mark.parametrize("average", [False, pytest.param(True, marks=pytest.mark.thorough)])
def test_gradient_in_width(average):
    """Zero where the PSF is point-sampled (a step); of the pixel average, exact.

    The average is smooth in the width until the edge crosses into the next pixel, 0.02 mm away
    here; β·width·step = 0.003 rad for the step 1e-4, far from it (see `finite_difference`).
    """
    weight = jnp.asarray(np.random.default_rng(5).normal(size=(11, 14)))

    @jax.jit
    def loss(width):
        mask = tc.FresnelZoneAperture(BETA, PHASE, width=width, centre=CENTRE)
        camera = tc.LenslessCamera(mask, tc.Sensor((11, 14), 0.11), 5.0)
        h = tc.psf(
            camera,
            wavelength=500e-6,
            object_distance=20.0,
            model="geometric",
            pixel_integration=average,
        )
        return jnp.sum(h * weight)

    width = jnp.asarray(1.0)
    slope = jax.jit(lambda w: jax.jvp(loss, (w,), (jnp.ones(()),))[1])(width)
    difference = finite_difference(loss, width, jnp.ones(()), 1e-4)
    np.testing.assert_allclose(slope, difference, rtol=1e-8, atol=1e-13)
    assert (abs(slope) > 0.1) == average
