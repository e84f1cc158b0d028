"""Synthesised responses against the thesis' formulas (ERRATA 3.31, 3.49), and the MTF."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thincam_jax as tc
from helpers import finite_difference, quick, relative_l2
from thincam_jax.lensless.masks.base import require_zone_orders
from thincam_jax.lensless.phase_shift import fringe_scanned_otf, harmonic_otf, phase_pair_otf
from thincam_jax.units import nm, um

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


def harmonic_response(mask, path, harmonic, frequency_squared):
    """Response of a harmonic m > 0 of the captures over the mask's phase, mm².

    jπ/(mβ) Σ_{k−l=m} c_k c_l* e^{−j(X/m)(1 + kε)(1 + lε)}, X = π²ρ²/β, ε = βλd/π (β/M² for β, ε/M
    for ε from a near point): orders that differ by m share a carrier; exact without an edge.
    """
    zones = require_zone_orders(mask, "closed_form")
    orders = zones.orders
    pairs = [
        (orders.index(k + harmonic), n) for n, k in enumerate(orders) if k + harmonic in orders
    ]
    first, second = np.asarray(pairs, int).T
    gain = 1 + np.asarray(orders) * float(path.epsilon(zones.beta))
    beta = harmonic * float(zones.beta) / float(path.magnification) ** 2
    squared, coefficients = np.asarray(frequency_squared)[..., None], np.asarray(zones.coefficients)
    waves = np.exp(-1j * np.pi**2 * squared / beta * gain[first] * gain[second])
    weights = coefficients[first] * coefficients[second].conj()
    return np.sum(weights * waves, axis=-1) * 1j * np.pi / beta


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


def test_other_masks_are_refused():
    other = tc.LenslessCamera(tc.SampledMask(jnp.ones((3, 4)), 0.1), tc.Sensor((4, 5), 0.1), 5.0)
    with pytest.raises(TypeError, match="the camera has a SampledMask"):
        phase_pair_otf(other, wavelength=WAVELENGTH, pixel_integration=False)


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
