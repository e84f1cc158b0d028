"""The thesis' approximation for weak diffraction: its formulas, and how it departs."""

import jax.numpy as jnp
import numpy as np
import pytest
from lensless.propagation import reference

import thincam_jax as tc
from helpers import point_psf
from thincam_jax.lensless.propagation.closed_form import paraxial_response

BETA, PHASE = 25.0, 0.8


def psf_of(model, wavelength, *, shape=(50, 61), pitch=0.01, distance=6.5, t=np.inf, **mask):
    camera = tc.LenslessCamera(
        tc.FresnelZoneAperture(BETA, PHASE, width=2.0, **mask), tc.Sensor(shape, pitch), distance
    )
    return np.asarray(point_psf(camera, wavelength=wavelength, object_distance=t, model=model))


@pytest.mark.parametrize("t", [np.inf, 70.0])
def test_is_the_thesis_formula(t):
    """Eq 3.26 corrected: ¼ + ½cos(εβr²)cos(βr²+φ) + ¼cos²(βr²+φ), with the plus before φ."""
    m = 1 + 6.5 / t
    y, x = reference.centred(50, 0.01) / m - 0.04, reference.centred(61, 0.01) / m + 0.1
    r2 = y[:, None] ** 2 + x**2
    eps = BETA * 500e-6 * 6.5 / m / np.pi
    zones = np.cos(BETA * r2 + PHASE)
    expected = 0.25 + 0.5 * np.cos(eps * BETA * r2) * zones + 0.25 * zones**2
    value = psf_of("paraxial", 500e-6, t=t, centre=(0.04, -0.1))
    np.testing.assert_allclose(value, expected, rtol=0, atol=1e-12)


def test_departs_as_the_square_of_epsilon():
    """What is left out is ε²βr² in the phase and ε² in the gains: under ε²(1 + βr²) everywhere,
    nearly reached, a quarter of it at half the wavelength, and growing with r²."""
    y, x = reference.centred(50, 0.01), reference.centred(61, 0.01)
    turns = BETA * (y[:, None] ** 2 + x**2)  # up to 3.8
    errors = []
    for wavelength in (500e-6, 250e-6, 125e-6):
        eps = BETA * wavelength * 6.5 / np.pi
        difference = psf_of("closed_form", wavelength) - psf_of("paraxial", wavelength)
        scaled = np.abs(difference) / (eps**2 * (1 + turns))
        assert 0.2 < scaled.max() < 1.0
        errors.append(np.abs(difference))
    for coarse, fine in zip(errors[:-1], errors[1:], strict=True):
        assert 3.8 < coarse.max() / fine.max() < 4.2
    assert errors[0][turns > 3].max() > 2.5 * errors[0][turns < 0.3].max()


def test_binary_profile_is_the_same_expansion():
    """Every pair of orders k, l: the phase βr²(k−l)(1 − (k+l)ε), and the gains set to 1."""
    eps = BETA * 500e-6 * 6.5 / np.pi
    orders = {0: 0.5} | {k: np.sin(k * np.pi / 2) / (k * np.pi) for k in (1, -1, 3, -3)}
    y, x = reference.centred(50, 0.01), reference.centred(61, 0.01)
    r2 = y[:, None] ** 2 + x**2
    expected = sum(
        a * b * np.cos(BETA * r2 * (k - m) * (1 - (k + m) * eps) + (k - m) * PHASE)
        for k, a in orders.items()
        for m, b in orders.items()
    )
    value = psf_of("paraxial", 500e-6, profile="binary", harmonics=3)
    np.testing.assert_allclose(value, expected, rtol=0, atol=1e-12)


def test_response_is_eq_3_30_corrected():
    beta, phase, wavelength, d = 25.0, 0.7, 500e-6, 6.5
    rho = np.linspace(0.0, 25.0, 101)
    x = np.pi**2 * rho**2 / beta
    expected = (
        np.cos(np.pi * wavelength * d * rho**2) * np.sin(x - phase) * np.pi / (2 * beta)
    ) + np.sin(x / 2 - 2 * phase) * np.pi / (16 * beta)
    value = paraxial_response(jnp.asarray(rho**2), beta, phase, wavelength, d)
    np.testing.assert_allclose(value, expected, rtol=0, atol=1e-13)


def test_refuses_display_pixels():
    with pytest.raises(ValueError, match="'paraxial' has no display pixels; drop pixel_pitch"):
        psf_of("paraxial", 500e-6, pixel_pitch=0.1)


@pytest.mark.parametrize("profile", ["cosine", "binary"])
def test_phases_far_outside_its_validity_take_double_precision(profile):
    """β = 1e6, d = 990 mm: float32 left an irradiance of −0.17."""
    mask = tc.FresnelZoneAperture(1e6, 0.4, width=0.3, profile=profile)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 0.3 / 32), 990.0)
    single, double = (tc.PsfMethod("paraxial", precision=p) for p in ("float32", "float64"))
    with pytest.raises(ValueError, match=r"PsfMethod\('paraxial', precision='float64'\)"):
        point_psf(camera, wavelength=500e-6, model=single)
    assert float(point_psf(camera, wavelength=500e-6, model=double).min()) > -1e-6
