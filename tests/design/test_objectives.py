"""Objectives: against linear algebra, random draws, made-up channels and differences."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from design import small
from design.setting import HIGHEST, setup

from helpers import count_traces, finite_difference
from thincam_jax.design import BayesError, PhotonNoise, PowerLaw, SignalNoise
from thincam_jax.design.design import Design
from thincam_jax.design.objectives import (
    Channels,
    ResolutionLimit,
    Unevenness,
    WorstRatio,
    bayes_error,
    channels,
    limit,
    mismatch_error,
    unevenness,
    worst_ratio_db,
)
from thincam_jax.design.setup import Polar, Quadrant
from thincam_jax.lensless.exposures import Exposures
from thincam_jax.reconstruction import phase_pairs

N = 48


def made_up(seed=0, count=3):
    """Channels on N frequencies of a periodic line, even as those of real signals."""
    rng = np.random.default_rng(seed)
    frequency = np.abs(np.fft.fftfreq(N) * N)
    response = np.cos(np.outer(rng.uniform(0.02, 0.06, count), frequency**2)) / (1 + frequency / 20)
    noise = rng.uniform(0.05, 0.2, (count, N // 2 + 1))[:, frequency.astype(int)]
    density = 4.0 / (1 + frequency**2 / 9)
    return Channels(*map(jnp.asarray, (response, noise, density, np.full(N, 1.0 / N))))


def circulant(spectrum):
    return np.stack([np.roll(np.fft.ifft(spectrum).real, i) for i in range(N)], axis=1)


def matrices(known):
    system = np.concatenate([circulant(h) for h in np.asarray(known.response)])
    noise = np.zeros((len(system), len(system)))
    for i, spectrum in enumerate(np.asarray(known.noise)):
        noise[i * N : (i + 1) * N, i * N : (i + 1) * N] = circulant(spectrum)
    return system, noise, circulant(np.asarray(known.density))


def test_bayes_error_of_dense_matrices():
    """Posterior covariance (S⁻¹ + AᵀN⁻¹A)⁻¹ of a line of 48 points seen three times."""
    known = made_up()
    system, noise, prior = matrices(known)
    posterior = np.linalg.inv(np.linalg.inv(prior) + system.T @ np.linalg.solve(noise, system))
    expected = np.trace(posterior) / np.trace(prior)
    assert 0.01 < expected < 0.9
    np.testing.assert_allclose(bayes_error(known), expected, rtol=1e-10)


def test_errors_of_a_filter_at_work():
    """3000 random lines through a Wiener filter made for one camera, seen by it and by another."""
    known, actual = made_up(), made_up(1)
    system, noise, prior = matrices(known)
    wiener = prior @ system.T @ np.linalg.inv(system @ prior @ system.T + noise)
    rng = np.random.default_rng(5)
    for camera, predicted in ((known, bayes_error(known)), (actual, mismatch_error(known, actual))):
        seen, its_noise, _ = matrices(camera)
        scenes = np.linalg.cholesky(prior) @ rng.normal(size=(N, 3000))
        captures = seen @ scenes
        captures += np.linalg.cholesky(its_noise) @ rng.normal(size=captures.shape)
        made = np.mean((wiener @ captures - scenes) ** 2) / (np.trace(prior) / N)
        np.testing.assert_allclose(predicted, made, rtol=0.02)  # 3000·48 draws: 1 % is 3 σ


FREQUENCIES = Polar(100.0, 640, 2)


def compiled(value):
    return jax.jit(value)()


def of_ratio(ratio):
    """One channel whose signal-to-noise ratio is a function of the radius as a part of 100."""
    place = jnp.broadcast_to(FREQUENCIES.radius / 100.0, FREQUENCIES.weight.shape)
    ones = jnp.ones_like(place)
    return Channels(jnp.sqrt(ratio(place))[None], ones[None], ones, FREQUENCIES.weight)


def test_worst_ratio():
    """20 dB but for one ring of 64 at 3 dB; 1000 times lower outside the band."""

    def ratio(place):
        dip = (place > 32 / 64) & (place < 33 / 64)
        inside = (place > 0.2) & (place < 0.8)
        return jnp.where(dip, 10**0.3, 100.0) * jnp.where(inside, 1.0, 1e-3)

    value = compiled(lambda: worst_ratio_db(of_ratio(ratio), FREQUENCIES, (0.21, 0.79)))
    np.testing.assert_allclose(value, 3.0, atol=1e-5)
    even = of_ratio(lambda p: 100.0 + 0 * p)
    flat = compiled(lambda: worst_ratio_db(even, FREQUENCIES, (0.25, 0.75)))
    np.testing.assert_allclose(flat, 20.0 - math.log(32), rtol=1e-10)  # soft: 32 equal rings


def test_unevenness():
    """Rings that alternate by ±2 dB spread by 2 dB; flat ones by nothing; the scene's power not."""

    def ratio(place):
        return 10 ** (0.2 * jnp.where(jnp.floor(place * 64) % 2 == 0, 1.0, -1.0))

    known = of_ratio(ratio)
    steep = replace(known, density=1e3 / (1 + FREQUENCIES.squared))
    flat = of_ratio(lambda p: 5.0 + 0 * p)
    spread = jax.jit(lambda channels: unevenness(channels, FREQUENCIES, (0.25, 0.75)))
    np.testing.assert_allclose([spread(known), spread(steep)], 2.0, rtol=1e-6)
    assert float(spread(flat)) < 1e-6
    slope = jax.jit(
        jax.grad(lambda s: unevenness(of_ratio(lambda p: s + 0 * p), FREQUENCIES, (0.2, 0.8)))
    )
    assert np.isfinite(float(slope(5.0)))


def test_limit():
    """1 is crossed at 0.4 and 0.7; never; at once; and a ratio of 10 earlier."""

    def falling(place):
        return jnp.exp(8 * (0.4 - place))

    np.testing.assert_allclose(limit(of_ratio(falling), FREQUENCIES), 40.0, atol=0.1)
    expected = 40.0 - 100 * math.log(10) / 8
    np.testing.assert_allclose(
        limit(of_ratio(falling), FREQUENCIES, ratio=10.0), expected, atol=0.1
    )
    returning = of_ratio(
        lambda p: jnp.where(p < 0.4, falling(p), falling(p) + jnp.where(p > 0.6, 2.0, 0.0))
    )
    np.testing.assert_allclose(limit(returning, FREQUENCIES), 40.0, atol=0.1)
    np.testing.assert_allclose(limit(of_ratio(lambda p: 2 + 0 * p), FREQUENCIES), 100.0)
    np.testing.assert_allclose(limit(of_ratio(lambda p: 0.5 + 0 * p), FREQUENCIES), 0.0)


BAND = (0.15, 0.85)
OTHER = Design(
    Exposures(
        [24.9, 24.8, 21.2, 21.1],
        [6.5, 6.5, 6.6, 6.6],
        phase=[0.1, 4.8, 0.0, 4.6],
        wavelength=505e-6,
        width=5.6,
        relative_time=0.25,
    )
)
TESTED = Design(
    Exposures(
        [25.0, 25.1, 21.0, 20.9],
        [6.5, 6.4, 6.5, 6.6],
        phase=[0.0, 4.7, 0.1, 4.6],
        wavelength=[500e-6, 510e-6, 490e-6, 500e-6],
        width=5.632,
        relative_time=[0.2, 0.3, 0.25, 0.25],
    )
)


def every_objective(design, judged, frequencies):
    known, other = (
        channels(d, judged, jnp.asarray(phase_pairs(2)), frequencies) for d in (design, OTHER)
    )
    return {
        "bayes_error": bayes_error(known),
        "mismatch_error": mismatch_error(known, other),
        "worst_ratio_db": worst_ratio_db(known, frequencies, BAND, rings=16),
        "unevenness": unevenness(known, frequencies, BAND, rings=16),
        "limit": limit(known, frequencies, ratio=THRESHOLD, rings=16),
    }


OBJECTIVES = ("bayes_error", "mismatch_error", "worst_ratio_db", "unevenness", "limit")


# Between the ratios of the first rings and of the last, so that `limit` lies inside and is smooth:
# it jumps where a ring that was above falls below it, which no ring is near to here.
THRESHOLD = 30.0
NAMES = ("beta", "phase", "distance", "wavelength", "width", "exposure")


@pytest.mark.parametrize(
    ("frequencies", "noise"),
    [
        pytest.param(Polar(HIGHEST, 128, 2), SignalNoise(30.0), marks=pytest.mark.thorough),
        (Quadrant(HIGHEST, 33), PhotonNoise(2000.0, 8.0)),
        pytest.param(Polar(HIGHEST, 128, 2), PhotonNoise(2000.0, 8.0), marks=pytest.mark.thorough),
        pytest.param(Quadrant(HIGHEST, 33), SignalNoise(30.0), marks=pytest.mark.thorough),
    ],
    ids=["polar-snr", "quadrant-photons", "polar-photons", "quadrant-snr"],
)
def test_gradients(noise, frequencies):
    """Of every objective in every number, against central differences: relative 1e-4.

    The kinks are those of `limit` (which ring is the first below), of the crop (a frequency whose
    light leaves the sensor altogether) and of the object's and the shadow's width in the light;
    a step of 1e-6 meets none here.
    """
    judged = setup(noise=noise, prior=PowerLaw(2.8))
    counted = count_traces(every_objective)

    @jax.jit
    def value_and_pullback(design, weights):
        """All objectives, and the gradient of their weighted sum: one program for all."""
        values, pullback = jax.vjp(lambda d: counted(d, judged, frequencies), design)
        return values, pullback(weights)[0]

    nothing = dict.fromkeys(OBJECTIVES, jnp.zeros(()))
    values = value_and_pullback(TESTED, nothing)[0]
    slopes = {
        objective: value_and_pullback(TESTED, nothing | {objective: jnp.ones(())})[1]
        for objective in OBJECTIVES
    }
    for name in NAMES:
        number = getattr(TESTED, name)
        # Each capture by its own step, or effects of captures could stand in for one another.
        step = number * jnp.asarray([1.0, -0.3, 0.6, 0.2]) if number.ndim else number
        if name == "phase":
            step = jnp.asarray([1.0, -0.3, 0.6, 0.2])
        zero = jax.tree.map(jnp.zeros_like, TESTED)
        direction = jax.tree.map(lambda x: x, zero)
        object.__setattr__(direction, name, step)

        def moved(d):
            return value_and_pullback(d, nothing)[0]

        expected = finite_difference(moved, TESTED, direction, 2e-6)
        # Its filters divide by small noises: shorter steps drown in rounding.
        longer = finite_difference(moved, TESTED, direction, 1e-5)
        expected["mismatch_error"] = longer["mismatch_error"]
        for objective, difference in expected.items():
            slope = float(jnp.sum(getattr(slopes[objective], name) * step))
            rounding = 3e-8 * (1 + abs(float(values[objective])))
            # On a Quadrant, where the filters' peak at zero lies on a sample, rounding leaves no
            # better difference of the mismatch at any step.
            relative = 1e-4
            if objective == "mismatch_error" and isinstance(frequencies, Quadrant):
                relative = 5e-3
            error = abs(slope - float(difference))
            assert error <= relative * abs(slope) + rounding, (name, objective)
            if not (name == "exposure" and isinstance(noise, SignalNoise)):
                assert slope != 0.0, (name, objective)
    assert counted.traces == 1


def test_objectives_are_minimised_and_reported_in_their_sense():
    problem, band = small.problem(), (0.1, 0.6)
    data, design = problem.data, problem.space.base
    error, edge, uneven, ratio = BayesError(), ResolutionLimit(), Unevenness(band), WorstRatio(band)

    @jax.jit
    def costs_and_channels(design, data):
        return [one(design, data) for one in (error, edge, uneven)], data.channels(design)

    (of_error, of_edge, of_uneven), known = costs_and_channels(design, data)
    cost = float(of_error)
    assert cost == pytest.approx(float(bayes_error(known)))
    assert error.reported(cost) == pytest.approx(10 * np.log10(cost))
    assert error.gain(0.2, 0.1) == pytest.approx(3.0103, abs=1e-4)
    assert error.increase(0.2) == pytest.approx(0.002)
    cost = float(of_edge)
    assert cost == pytest.approx(-float(limit(known, data.frequencies)))
    expected = float(unevenness(known, data.frequencies, band))
    assert float(of_uneven) == pytest.approx(expected)
    assert edge.reported(cost) == -cost > 0
    assert edge.gain(-10.0, -12.0) == pytest.approx(2.0)
    assert uneven.gain(3.0, 2.0) == pytest.approx(1.0)
    assert ratio.gain(-10.0, -12.0) == pytest.approx(2.0)
    assert ratio.increase(40.0) == pytest.approx(10 * np.log10(1.01), abs=1e-4)
    assert hash(ratio) == hash(WorstRatio(band))  # compiled once
    assert WorstRatio(band) == ratio != WorstRatio()
    assert edge.label == "limit of resolution (cycles/rad)"
