"""Synthesised responses against the thesis' formulas, written out here (ERRATA 3.31, 3.49)."""

import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import relative_l2

# Weak diffraction (ε = 4e-5), so that ε in the chirps' curvatures does not show; the zero of
# cos(πλdρ²) is made to lie in the band by a frequency grid that reaches far.
BETA, DISTANCE, WAVELENGTH = 20.0, 0.25, 2.5e-5


def camera(phase=1.234, **mask):
    sensor = tc.Sensor(shape=(30, 41), pitch=0.02)
    return tc.LenslessCamera(
        tc.FresnelZoneAperture(BETA, phase, width=1.0, **mask), sensor, DISTANCE
    )


def squared_frequency():
    v = (np.arange(30) - 15) / (30 * 0.02)
    u = (np.arange(41) - 20) / (41 * 0.02)
    return v[:, None] ** 2 + u**2


def test_fringe_scanned():
    rho2 = squared_frequency()
    expected = (
        np.pi
        / BETA
        * np.exp(1j * np.pi**2 * rho2 / BETA)
        * np.cos(np.pi * WAVELENGTH * DISTANCE * rho2)
    )
    found = tc.fringe_scanned_otf(camera(), wavelength=WAVELENGTH, model="paraxial")
    # Left out by Eq 3.31: ε X in the phase, at most 4e-5 · 600 rad.
    assert relative_l2(found, expected) < 0.02
    assert relative_l2(found.conj(), expected) > 1


def test_phase_pair():
    rho2 = squared_frequency()
    x = np.pi**2 * rho2 / BETA
    expected = np.pi / (2 * BETA) * np.cos(np.pi * WAVELENGTH * DISTANCE * rho2) * (
        np.sin(x) - np.cos(x)
    ) + np.pi / (8 * BETA) * np.sin(x / 2)
    found = tc.phase_pair_otf(camera(), wavelength=WAVELENGTH, model="paraxial")
    assert relative_l2(found, expected) < 0.02
    assert relative_l2(-found, expected) > 1


def test_shadow_of_a_finite_mask():
    """h(3π/2) − h(π/2) = sin βr² and h(0) − h(π) = cos βr² inside the shadow, nothing outside."""
    y = (np.arange(30) - 14.5) * 0.02
    x = (np.arange(41) - 20) * 0.02
    inside = (abs(y) <= 0.25)[:, None] & (abs(x) <= 0.25)
    r2 = y[:, None] ** 2 + x**2
    image = np.where(inside, np.sin(BETA * r2) + 1j * np.cos(BETA * r2), 0)
    rows = np.exp(-2j * np.pi * np.outer((np.arange(30) - 15) / (30 * 0.02), y))
    columns = np.exp(-2j * np.pi * np.outer(x, (np.arange(41) - 20) / (41 * 0.02)))
    small = tc.LenslessCamera(
        tc.FresnelZoneAperture(BETA, 0.7, width=0.5), tc.Sensor(shape=(30, 41), pitch=0.02), 5.0
    )
    found = tc.fringe_scanned_otf(small, wavelength=WAVELENGTH, model="geometric")
    assert relative_l2(found, rows @ image @ columns * 0.02**2) < 1e-12


def test_other_masks_are_refused():
    other = tc.LenslessCamera(tc.SampledMask(jnp.ones((3, 4)), 0.1), tc.Sensor((4, 5), 0.1), 5.0)
    with pytest.raises(TypeError, match="the camera has a SampledMask"):
        tc.phase_pair_otf(other, wavelength=WAVELENGTH)
