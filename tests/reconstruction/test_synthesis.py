"""The synthesis matrices, on the analytic transfer functions: ERRATA 3.31 and 3.49."""

import math

import numpy as np
import pytest

import thincam_jax as tc
from helpers import relative_l2
from thincam_jax.lensless.propagation.closed_form import paraxial_response
from thincam_jax.reconstruction import fringe_scanning, phase_pairs
from thincam_jax.reconstruction.synthesis import contrasts, harmonics, phase_contrasts, separate
from thincam_jax.units import nm, um

BETA, DISTANCE, WAVELENGTH = 25.0, 6.5, 500 * nm
SENSOR = tc.Sensor((60, 75), 10 * um)
FOUR = [0.0, math.pi / 2, math.pi, 3 * math.pi / 2]
PAIR = [0.0, 3 * math.pi / 2]


def squared_frequency():
    v, u = np.asarray(SENSOR.grid.v), np.asarray(SENSOR.grid.u)
    return v[:, None] ** 2 + u**2


def angles(beta=BETA, distance=DISTANCE):
    """X = π²ρ²/β and πλdρ²."""
    squared = squared_frequency()
    return math.pi**2 * squared / beta, math.pi * WAVELENGTH * distance * squared


def formula(phases, beta=BETA, distance=DISTANCE):
    """Responses after Eq 3.30 (corrected): to first order in ε = βλd/π."""
    squared = squared_frequency()
    return np.stack([paraxial_response(squared, beta, p, WAVELENGTH, distance) for p in phases])


def model(phases, distance, beta=BETA):
    """Responses of the paraxial model for t = ∞."""
    masks = [tc.FresnelZoneAperture(beta, phase, width=4.0) for phase in phases]
    cameras = [tc.LenslessCamera(mask, SENSOR, distance) for mask in masks]
    return np.stack(
        [
            tc.otf(c, wavelength=WAVELENGTH, model="paraxial", pixel_integration=False)
            for c in cameras
        ]
    )


def scanned(beta=BETA, distance=DISTANCE):
    """ERRATA 3.31: (π/β)·exp(jX)·cos(πλdρ²)."""
    x, diffraction = angles(beta, distance)
    return math.pi / beta * np.exp(1j * x) * np.cos(diffraction)


def paired(beta=BETA, distance=DISTANCE):
    """ERRATA 3.49: (π/2β)·cos(πλdρ²)·[sin X − cos X] + (π/8β)·sin(X/2)."""
    x, diffraction = angles(beta, distance)
    first = math.pi / (2 * beta) * np.cos(diffraction) * (np.sin(x) - np.cos(x))
    return first + math.pi / (8 * beta) * np.sin(x / 2)


def test_fringe_scanning_gives_the_complex_chirp():
    """{H(3π/2) − H(π/2)} + j{H(0) − H(π)}."""
    real, imaginary = np.tensordot(fringe_scanning(1), formula(FOUR), axes=1)
    assert relative_l2(real + 1j * imaginary, scanned()) < 1e-12


def test_phase_pairs_keep_the_second_harmonic():
    """H(0) − H(3π/2)."""
    (value,) = np.tensordot(phase_pairs(1), formula(PAIR), axes=1)
    assert relative_l2(value, paired()) < 1e-12


@pytest.mark.parametrize("distance", [0.65, 0.325])
def test_the_paraxial_model_has_these_responses(distance):
    """It keeps curvatures β(1 ∓ ε) where the formulas expand 1/(1 ∓ ε): a difference of order ε.

    On this grid ε²X reaches 5ε, so that the formulas hold to some ε; the cosine makes half a turn
    and more.
    """
    epsilon = BETA * WAVELENGTH * distance / math.pi
    real, imaginary = np.tensordot(fringe_scanning(1), model(FOUR, distance), axes=1)
    error = relative_l2(real + 1j * imaginary, scanned(distance=distance))
    (value,) = np.tensordot(phase_pairs(1), model(PAIR, distance), axes=1)
    other = relative_l2(value, paired(distance=distance))
    assert error < 3 * epsilon and other < 3 * epsilon
    assert angles(distance=distance)[1].max() > math.pi / 2


def test_first_zero_of_the_fringe_scanned_response():
    """At ρ = 1/√(2λd): 12.40 cycles/mm at 6.5 mm and 14.14 at 5.0, on the x axis of the grid."""
    sensor = tc.Sensor((1, 4001), 10 * um)
    for distance, zero in ((6.5, 12.40), (5.0, 14.14)):
        cameras = [
            tc.LenslessCamera(tc.FresnelZoneAperture(BETA, phase, width=4.0), sensor, distance)
            for phase in FOUR
        ]
        h = np.stack(
            [
                tc.otf(c, wavelength=WAVELENGTH, model="paraxial", pixel_integration=False)[0]
                for c in cameras
            ]
        )
        real, imaginary = np.tensordot(fringe_scanning(1), h, axes=1)
        size, u = np.abs(real + 1j * imaginary), np.asarray(sensor.grid.u)
        near = (u > 5.0) & (u < 18.0)
        assert abs(u[near][np.argmin(size[near])] - zero) < 0.05


def test_harmonics_are_those_of_the_responses():
    """jK times what `harmonic_otf` gives, conjugate; of a cosine none but two."""
    steps = [2 * math.pi * q / 7 for q in range(7)]
    channels = np.tensordot(harmonics(1, 7, (1, 2, 3)), formula(steps), axes=1)
    x, diffraction = angles()
    expected = [
        math.pi / (4 * BETA) * np.exp(1j * x) * np.cos(diffraction),
        math.pi / (32 * BETA) * np.exp(0.5j * x),
    ]
    for m in (0, 1):
        assert relative_l2(channels[2 * m] + 1j * channels[2 * m + 1], 7 * expected[m]) < 1e-12
    assert np.abs(channels[4:]).max() < 1e-12


def test_groups_stay_apart():
    """Two distances, two β: each channel holds its own group's response only."""
    both = np.concatenate([formula(FOUR), formula(FOUR, distance=4.0)])
    channels = np.tensordot(fringe_scanning(2), both, axes=1)
    assert relative_l2(channels[2] + 1j * channels[3], scanned(distance=4.0)) < 1e-12
    both = np.concatenate([formula(PAIR), formula(PAIR, beta=21.0)])
    channels = np.tensordot(phase_pairs(2), both, axes=1)
    assert relative_l2(channels[0], paired()) < 1e-12
    assert relative_l2(channels[1], paired(beta=21.0)) < 1e-12


def test_noise_of_the_channels_is_uncorrelated():
    """Rows orthogonal; the differences of two captures carry the noise of two."""
    for matrix, power in (
        (separate(3), 1.0),
        (fringe_scanning(2), 2.0),
        (phase_pairs(3), 2.0),
        (harmonics(2, 8, (1, 3)), 4.0),
    ):
        np.testing.assert_allclose(matrix @ matrix.T, power * np.eye(len(matrix)), atol=1e-14)


@pytest.mark.parametrize("count", [2, 3, 7])
def test_contrasts_say_all_beside_the_common_background(count):
    """Orthonormal, and with the even row a whole basis: nothing but the mean is left out."""
    matrix = contrasts(count)
    even = np.full((1, count), count**-0.5)
    whole = np.concatenate([matrix, even])
    np.testing.assert_allclose(whole @ whole.T, np.eye(count), atol=1e-14)


def test_contrasts_keep_a_channel_that_pairs_lose():
    """Of two β at phases 0 and 3π/2: both pairs, and (g₁ + g₂) − (g₃ + g₄) with fringes like them.

    Away from the finest and the coarsest zones all three carry the same power; the background,
    16 times a fringe here, is in none of them.
    """
    responses = np.concatenate([formula(PAIR), formula(PAIR, beta=21.0)])
    third = np.array([[0.5, 0.5, -0.5, -0.5]])
    known = np.concatenate([phase_pairs(2) / math.sqrt(2), third])
    assert np.linalg.matrix_rank(np.concatenate([contrasts(4), known])) == 3
    power = np.mean(np.abs(np.tensordot(known, responses, axes=1)) ** 2, axis=(1, 2))
    assert power[2] == pytest.approx(np.mean(power[:2]), rel=0.25)
    flat = np.ones((4, 3, 5))
    np.testing.assert_allclose(np.tensordot(contrasts(4), flat, axes=1), 0, atol=1e-14)


def test_only_captures_that_differ_in_phase_are_combined():
    def rig(phase, beta=25.0):
        mask = tc.FresnelZoneAperture(beta, phase, width=4.0)
        return tc.LenslessCamera(mask, SENSOR, DISTANCE)

    two = [rig(0.0), rig(0.0, 20.0), rig(math.pi / 2), rig(math.pi / 2, 20.0)]
    expected = np.array([[1, 0, -1, 0], [0, 1, 0, -1]]) / math.sqrt(2)
    np.testing.assert_allclose(np.abs(phase_contrasts(two, WAVELENGTH)), np.abs(expected))
    np.testing.assert_allclose(phase_contrasts(two, WAVELENGTH).sum(axis=1), 0, atol=1e-15)
    colours = [400 * nm, 400 * nm, 600 * nm, 400 * nm]
    np.testing.assert_array_equal(
        np.abs(phase_contrasts(two, colours)) > 0, [[1, 0, 0, 0], [0, 1, 0, 1], [0, 0, 1, 0]]
    )
    same = [rig(0.0), rig(2 * math.pi)]
    np.testing.assert_array_equal(phase_contrasts(same, WAVELENGTH), np.eye(2))
    pinhole = tc.LenslessCamera(tc.Pinhole(0.1), SENSOR, DISTANCE)
    np.testing.assert_array_equal(phase_contrasts([pinhole] * 2, WAVELENGTH), np.eye(2))


@pytest.mark.parametrize(("steps", "orders"), [(8, (4,)), (8, ()), (4, (2,)), (5, (0, 1))])
def test_harmonics_that_cannot_be_told_are_refused(steps, orders):
    with pytest.raises(ValueError, match=f"of {steps} phases; give some from 1 to"):
        harmonics(1, steps, orders)
