"""Limits of resolution: on responses whose limits are known, and on the thesis' two methods."""

import functools
import math

import numpy as np
import pytest
import scipy.special

from helpers import ROOT, quick, relative_l2
from thincam_jax.commands.kinds import load_experiment
from thincam_jax.commands.study.build import assemble
from thincam_jax.imaging.metrics.mtf import (
    cut_off,
    first_common_zero,
    low_frequency_value,
    zero_crossings,
)
from thincam_jax.studies.result import method_response

WAVELENGTH = 5e-4
STEP = 0.05
U = np.arange(0.0, 40.0, STEP)


def cosine(distance, frequency=U):
    """cos(πλdu²): a fringe-scanned response without its carrier (thesis Eq 3.31)."""
    return np.cos(math.pi * WAVELENGTH * distance * frequency**2)


def band(edge, frequency=U):
    return np.where(frequency <= edge, 1.0, 0.0)


class TestCutOff:
    @pytest.mark.parametrize("edge", [9.97, 22.4, 31.0])
    def test_ends_with_the_band_and_not_at_a_zero_inside(self, edge):
        response = np.abs(cosine(6.5)) * band(edge)
        assert np.min(response[U < 13]) < 0.01 or edge < 12.4  # it does have a zero before
        assert edge - STEP <= cut_off(U, response) <= edge + STEP

    def test_interpolates(self):
        """A straight fall of 0.1 per cycle/mm from 1 at 20 reaches 5 % at 29.5 exactly."""
        fall = np.interp(U, [20, 30], [1.0, 0.0])
        assert cut_off(U, fall) == pytest.approx(29.5, abs=1e-9)
        assert cut_off(U, fall, part=0.5) == pytest.approx(25.0, abs=1e-9)

    def test_counts_from_where_it_stays_under(self):
        """A revival above 5 % moves the limit; one below it does not."""
        fall = np.interp(U, [20, 25], [1.0, 0.0])
        bump = np.exp(-((U - 33.0) ** 2))
        assert cut_off(U, fall + 0.04 * bump) == pytest.approx(24.75, abs=1e-6)
        expected = 33.0 + math.sqrt(math.log(0.1 / 0.05))
        assert cut_off(U, fall + 0.1 * bump) == pytest.approx(expected, abs=2e-3)

    def test_does_not_depend_on_scale_sign_phase_or_ripple(self):
        response = np.interp(U, [20, 30], [1.0, 0.0])
        ripple = 1 + 0.02 * np.sin(2 * math.pi * U / 0.31)
        for changed in (1e-9 * response, -response, response * np.exp(1j * U), response * ripple):
            assert cut_off(U, changed) == pytest.approx(29.5, abs=0.03)

    def test_the_bias_at_zero_does_not_count(self):
        biased = np.interp(U, [20, 30], [1.0, 0.0])
        biased[0] = 1e4
        assert cut_off(U, biased) == pytest.approx(29.5, abs=1e-9)

    def test_band_without_end_is_cut_by_the_sampling(self):
        assert cut_off(U, np.ones_like(U)) == U[-1]

    def test_uneven_frequencies(self):
        uneven = 40 * np.linspace(0, 1, 900) ** 1.5
        fall = np.interp(uneven, [20, 30], [1.0, 0.0])
        assert cut_off(uneven, fall) == pytest.approx(29.5, abs=1e-6)


class TestFirstCommonZero:
    @pytest.mark.parametrize("distance", [5.0, 6.5])
    def test_of_one_cosine(self, distance):
        """πλdu² = π/2: 14.142 and 12.403 cycles/mm."""
        expected = math.sqrt(1 / (2 * WAVELENGTH * distance))
        assert first_common_zero(U, [cosine(distance)]) == pytest.approx(expected, abs=1e-3)

    def test_two_cosines_that_miss_nothing_together(self):
        """Zeros of d = 5.0 and 6.5 mm on the same axis: 14.1, 24.5 and 12.4, 21.5, 27.7."""
        seen = band(27.0)
        both = [cosine(5.0) * seen, cosine(6.5) * seen]
        assert first_common_zero(U, both) is None

    def test_two_cosines_with_a_common_zero(self):
        """Distances 1 : 3 share their odd multiples of π/2: the near one's first zero."""
        expected = math.sqrt(1 / (2 * WAVELENGTH * 2.5))
        both = [cosine(7.5), cosine(2.5)]
        assert first_common_zero(U, both) == pytest.approx(expected, abs=STEP)
        assert first_common_zero(U, both[::-1]) == pytest.approx(expected, abs=STEP)

    def test_end_of_the_band_is_no_zero(self):
        ends = np.interp(U, [8, 11], [1.0, 0.0])  # before the first zero at 12.4
        assert first_common_zero(U, [ends]) is None
        tail = ends + np.where(U > 11, 0.03 * np.cos(3 * U), 0.0)  # ringing about zero
        assert len(zero_crossings(U, tail)) > 10
        assert first_common_zero(U, [tail]) is None

    def test_ripple_on_a_cosine_moves_nothing(self):
        rippled = cosine(6.5) * (1 + 0.05 * np.sin(40 * U))
        assert first_common_zero(U, [rippled]) == pytest.approx(12.403, abs=2e-3)

    def test_a_crossing_in_one_only_is_none(self):
        assert first_common_zero(U, [cosine(6.5), np.ones_like(U)]) is None
        # In step of each other, but the second is far from small where the first vanishes.
        steep = np.where(U < 12.42, 1.0, -1.0)
        assert first_common_zero(U, [cosine(6.5) * 0.1, steep]) is None

    def test_uneven_frequencies(self):
        uneven = 40 * np.linspace(0, 1, 2000) ** 1.5
        found = first_common_zero(uneven, [cosine(6.5, uneven)])
        assert found == pytest.approx(12.403, abs=1e-3)


def test_zero_crossings_of_a_line():
    frequency = np.array([0.0, 1.0, 4.0, 5.0])  # uneven
    assert zero_crossings(frequency, np.array([3.0, 1.0, -5.0, 5.0])) == pytest.approx([1.5, 4.5])
    assert zero_crossings(frequency, np.array([1.0, 0.0, -1.0, -2.0])) == pytest.approx([1.0])
    assert zero_crossings(frequency, np.array([0.0, 1.0, 2.0, 3.0])).size == 0


def test_low_frequency_value_is_the_root_mean_square_of_the_lowest_twentieth():
    frequency = np.arange(101.0)
    response = np.where(frequency <= 5, 3.0, 7.0) * np.where(frequency % 2, 1, -1j)
    response[0] = 1e6
    assert low_frequency_value(frequency, response) == pytest.approx(3.0, rel=1e-12)


LINE = np.interp(U, [20, 30], [1.0, 0.0])


# The thesis' set-up (section 3.5.1): 1024² pixels of 5.5 µm, a mask of 5.632 mm, λ = 500 nm.
CONVENTIONAL_5, CONVENTIONAL_6, METHOD_A, METHOD_B = range(4)


def responses(distance, methods, **changes):
    changes = {"object.distance": f"{distance} mm", **changes}
    overrides = tuple(f"{key}={value}" for key, value in changes.items())
    config = load_experiment(ROOT / "configs" / "fza_superresolution.yaml", overrides)
    study = assemble(config)
    return [method_response(study, study.methods[index]) for index in methods]


@functools.cache
def distant(method):
    """The response for an object at 1 km, where the magnification is 1."""
    return responses(1e6, [method])[0]


@functools.cache
def near(method):
    """The response for the thesis' object at 250 mm."""
    return responses(250, [method])[0]


@pytest.mark.parametrize(
    ("method", "expected"), quick([(CONVENTIONAL_6, 12.40), (CONVENTIONAL_5, 14.14)], 0)
)
def test_first_zero_of_fringe_scanning(method, expected):
    """cos(πλdu²) = 0; the finite mask's ripple moves it by some 0.1."""
    found = distant(method).limits.first_zero_cycles_per_mm
    assert found == pytest.approx(expected, abs=0.3)


@pytest.mark.thorough
def test_two_distances_leave_no_zero():
    for response in (distant(METHOD_A), near(METHOD_A)):
        assert response.limits.first_zero_cycles_per_mm is None


@pytest.mark.thorough
def test_phase_pairs_have_no_first_zero():
    """ERRATA 3.49, 3.5.1: where cos(πλdu²) vanishes the second harmonic is left. What crosses zero
    is the carrier sin X − cos X; where, depends on the sampling.
    """
    for response in (distant(METHOD_B), near(METHOD_B)):
        assert response.limits.first_zero_cycles_per_mm is None
        assert response.limits.first_zero_object_mm is None
        for zero in (12.4, 21.5):
            around = np.abs(response.frequency - zero) < 0.4
            level = low_frequency_value(response.frequency, response.magnitude)
            assert response.magnitude[around].max() > 0.1 * level


def test_cut_off_of_method_a_is_the_aperture():
    """βR/π = 22.4 cycles/mm (ERRATA 3.5.1), and no zero at 22.9."""
    assert near(METHOD_A).limits.cut_off_cycles_per_mm == pytest.approx(22.4, abs=1.0)


def test_cut_off_of_method_b_is_its_second_harmonic():
    """2βR/π = 44.8 cycles/mm, twice that of method A, where the order still has 12 %."""
    assert distant(METHOD_B).limits.cut_off_cycles_per_mm >= 42
    assert distant(METHOD_B).limits.cut_off_cycles_per_mm == pytest.approx(44.8, abs=1.0)


@pytest.mark.thorough
def test_near_object_lowers_the_cut_off_by_the_magnification():
    """2βR/(πM²) for the part of the shadow on the sensor: 42.6 at the larger β."""
    limit = 2 * 25 / (1 + 6.5 / 250) ** 2 * 5.632 / 2 / math.pi
    assert near(METHOD_B).limits.cut_off_cycles_per_mm == pytest.approx(limit, abs=1.0)


def fields(beta, distance, x, half_width):
    """(order 0, +1, −1) one-dimensional fields for a plane wave, by scipy's Fresnel integrals."""
    b = math.pi / (WAVELENGTH * distance)
    orders = []
    for k in (0, 1, -1):
        a = k * beta + b  # exponent aξ² − 2bxξ + bx² = a(ξ − bx/a)² + (b − b²/a)x²
        scale = np.sqrt(2 * abs(a) / math.pi)
        edges = [scale * (end - b * x / a) for end in (-half_width, half_width)]
        (s0, c0), (s1, c1) = (scipy.special.fresnel(e) for e in edges)
        integral = ((c1 - c0) + 1j * math.copysign(1, a) * (s1 - s0)) / scale
        turned = integral * np.exp(1j * (b - b**2 / a) * x**2)
        orders.append(turned / np.sqrt(1j * WAVELENGTH * distance))
    return orders


def independent_response(beta, distance, phases, weights, *, shape, pitch):
    """Σ_p weight·OTF(u, 0) straight from |U|², with nothing of the package."""
    rows, columns = ((np.arange(n) - (n - 1) / 2) * pitch for n in shape)
    across, down = (fields(beta, distance, axis, 2.816) for axis in (columns, rows))
    total = 0
    for phase, weight in zip(phases, weights, strict=True):
        shares = (0.5, 0.25 * np.exp(1j * phase), 0.25 * np.exp(-1j * phase))
        field = sum(
            share * y[:, None] * x for share, y, x in zip(shares, down, across, strict=True)
        )
        total = total + weight * np.sum(np.abs(field) ** 2, axis=0)
    u = np.arange(shape[1] // 2) / (shape[1] * pitch)
    return (np.exp(-2j * np.pi * np.outer(u, columns)) @ total) * pitch**2


@pytest.mark.thorough
def test_responses_against_an_independent_evaluation():
    """Both kinds of synthesis, on a sensor that is not square and has no pixel average."""
    shape, pitch = (600, 1024), 5.5e-3
    changes = {"sensor.shape": f"[{shape[0]}, {shape[1]}]", "pixel_integration": "false"}
    # At 1e9 km the wave is plane.
    method_a, method_b = responses(1e15, (METHOD_A, METHOD_B), **changes)
    quarter = math.pi / 2
    powers = []
    for distance in (5.0, 6.5):
        phases = [0, quarter, 2 * quarter, 3 * quarter]
        scanned = [
            independent_response(25.0, distance, phases, weights, shape=shape, pitch=pitch)
            for weights in ((1, 0, -1, 0), (0, -1, 0, 1))
        ]
        power = sum(np.abs(channel) ** 2 for channel in scanned)
        u = method_a.frequency
        powers.append(np.interp(u * 6.5 / distance, u, power, right=0.0))
    # A rotation of the two channels, or a common factor, would not matter to either limit.
    assert relative_l2(method_a.magnitude, _scaled(powers, method_a.magnitude)) < 1e-7
    powers = [
        np.abs(independent_response(beta, 6.5, (0, 3 * quarter), (1, -1), shape=shape, pitch=pitch))
        ** 2
        for beta in (25.0, 21.0)
    ]
    assert relative_l2(method_b.magnitude, _scaled(powers, method_b.magnitude)) < 1e-7


def _scaled(powers, like):
    """The root of the mean power, with the one free factor of a synthesis matrix fitted."""
    magnitude = np.sqrt(np.mean(powers, axis=0))
    return magnitude * (magnitude @ like) / (magnitude @ magnitude)
