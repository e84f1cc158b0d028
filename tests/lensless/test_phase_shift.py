"""Synthesised responses against the thesis' formulas, written out here (ERRATA 3.31, 3.49)."""

import jax.numpy as jnp
import numpy as np
import pytest
from naive_formulas import harmonic_response

import thincam_jax as tc
from helpers import quick, relative_l2
from thincam_jax.lensless.phase_shift import fringe_scanned_otf, harmonic_otf, phase_pair_otf

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
    found = fringe_scanned_otf(
        camera(), wavelength=WAVELENGTH, model="paraxial", pixel_integration=False
    )
    # Left out by Eq 3.31: ε X in the phase, at most 4e-5 · 600 rad.
    assert relative_l2(found, expected) < 0.02
    assert relative_l2(found.conj(), expected) > 1


def test_phase_pair():
    rho2 = squared_frequency()
    x = np.pi**2 * rho2 / BETA
    expected = np.pi / (2 * BETA) * np.cos(np.pi * WAVELENGTH * DISTANCE * rho2) * (
        np.sin(x) - np.cos(x)
    ) + np.pi / (8 * BETA) * np.sin(x / 2)
    found = phase_pair_otf(
        camera(), wavelength=WAVELENGTH, model="paraxial", pixel_integration=False
    )
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
    found = fringe_scanned_otf(
        small, wavelength=WAVELENGTH, model="geometric", pixel_integration=False
    )
    assert relative_l2(found, rows @ image @ columns * 0.02**2) < 1e-12


class TestHarmonics:
    """Of the captures over the mask's phase."""

    @pytest.mark.thorough
    def test_they_make_the_capture_of_any_phase(self):
        """H(φ) = Σ H_m e^{jmφ}, with the finite mask; H_{-m} is that of the mirrored frequency."""
        lens = camera(phase=0.9, profile="cosine")
        light = {"wavelength": WAVELENGTH, "model": "separable"}
        found = [harmonic_otf(lens, m, **light, pixel_integration=False) for m in (0, 1, 2)]
        found = [np.asarray(h) for h in found]
        whole = found[0] + 2 * np.real(found[1] * np.exp(0.9j) + found[2] * np.exp(1.8j))
        # Symmetric masks have even responses: but for an even grid's first row.
        assert relative_l2(whole[1:], tc.otf(lens, **light, pixel_integration=False)[1:]) < 1e-10

    @pytest.mark.parametrize(
        ("profile", "present"), quick([("cosine", (1, 2)), ("binary", (2, 3, 6))], 1)
    )
    def test_closed_form(self, profile, present):
        """Against the phases of the same unbounded model."""
        lens = camera(phase=0.0, profile=profile, harmonics=3)
        path = lens.path(WAVELENGTH, 40.0)
        rho2 = squared_frequency() + 1e-9  # beside the δ of zero frequency
        for m in present:
            found = harmonic_response(lens.mask, path, m, rho2)
            expected = harmonic_otf(
                lens,
                m,
                wavelength=WAVELENGTH,
                object_distance=40.0,
                model="closed_form",
                pixel_integration=False,
            )
            assert relative_l2(found, expected) < 1e-6

    @pytest.mark.thorough
    def test_of_the_binary_profile(self):
        """j/(m²β) e^{-jX/m} times ±cos(πλdρ²) for odd m, ±sin for even m, which diffraction makes.

        λd = 1/800 mm²: the cosine's first zero is at 20 cycles/mm, where the sine is 1.
        """
        mask = tc.FresnelZoneAperture(BETA, width=1.0, profile="binary", harmonics=99)
        rho = np.linspace(0.5, 27.0, 300)
        path = tc.LenslessCamera(mask, tc.Sensor((4, 5), 0.1), 50.0).path(2.5e-5, np.inf)
        x, angle = np.pi**2 * rho**2 / BETA, np.pi * 2.5e-5 * 50.0 * rho**2
        factors = {1: np.cos(angle), 2: np.sin(angle), 3: -np.cos(angle), 4: -np.sin(angle)}
        for m, factor in factors.items():
            reached = angle < m * np.pi / 2
            expected = 1j / (m**2 * BETA) * np.exp(-1j * x / m) * factor
            found = np.asarray(harmonic_response(mask, path, m, rho**2))
            bound = 1e-12 if m % 2 else 0.03
            assert relative_l2(found[reached], expected[reached]) < bound
        assert abs(factors[1][np.argmin(abs(rho - 20))]) < 0.01

    def test_a_finite_mask_ends_them(self):
        """Each at mβR/π: nothing is left a little beyond; geometric amplitude as 1/m²."""
        zone = tc.FresnelZoneAperture(20.0, width=4.0, profile="binary")
        lens = tc.LenslessCamera(zone, tc.Sensor((1, 1601), 2.5e-3), 1e-3)
        u = np.asarray(lens.sensor.grid.u)
        level = {}
        for m in (1, 3):
            h = np.abs(
                harmonic_otf(lens, m, wavelength=5e-4, model="geometric", pixel_integration=False)[
                    0
                ]
            )
            end = m * 20.0 * 2.0 / np.pi
            level[m] = np.mean(h[(u > 0.2 * end) & (u < 0.8 * end)])
            assert np.mean(h[(u > 1.2 * end) & (u < 1.5 * end)]) < 0.1 * level[m]
        # One row of a sensor: along u alone the chirp has √(π/mβ) in place of π/mβ.
        assert level[1] / level[3] == pytest.approx(3**1.5, rel=0.03)

    def test_bad_harmonics_are_refused(self):
        with pytest.raises(ValueError, match="harmonic = -1; give a whole number"):
            harmonic_otf(camera(), -1, wavelength=WAVELENGTH, pixel_integration=False)
        path = camera().path(WAVELENGTH, np.inf)
        with pytest.raises(ValueError, match="harmonic = 0; give a whole number from 1 on"):
            harmonic_response(camera().mask, path, 0, 1.0)
        assert harmonic_response(camera().mask, path, 3, 1.0) == 0  # a cosine has two


def test_other_masks_are_refused():
    other = tc.LenslessCamera(tc.SampledMask(jnp.ones((3, 4)), 0.1), tc.Sensor((4, 5), 0.1), 5.0)
    with pytest.raises(TypeError, match="the camera has a SampledMask"):
        phase_pair_otf(other, wavelength=WAVELENGTH, pixel_integration=False)
