"""The limit: against all masks of a few cells, drawn and optimised ones, lenses and SciPy."""

import itertools
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from design import small
from shadow_masks import ShadowJudge, drawn_mask

from thincam_jax.design import (
    BayesError,
    DesignSpace,
    PhotonNoise,
    PowerLaw,
    Setup,
    Variable,
    design_problem,
    shots,
)
from thincam_jax.design.least_error import KINDS, limit
from thincam_jax.design.objectives import ObjectiveData
from thincam_jax.design.setup import Quadrant
from thincam_jax.design.space import Limits

LIGHTS = (PhotonNoise(3e2, 20.0), PhotonNoise(1e5, 0.0), PhotonNoise(1e5, 200.0))


def problem(noise=LIGHTS[0], captures=1, variables=(), width=1.6, count=32, exposure=1.0):
    """40 pixels of 50 µm at 5 mm, the object somewhat narrower than the mask's shadow.

    Half of the Nyquist frequency is 25 cycles/rad, and 20 samples resolve the fringes.
    """
    numbers = {"pitch": 0.05, "sensor_width": 2.0, "object_distance": 100.0, "object_width": 30.0}
    more = {"noise": noise, "prior": PowerLaw(2.5), "crop": False}
    setup = Setup(**(numbers | more))
    base = shots([20.0], 5.0, np.arange(1.0 * captures), wavelength=5e-4, width=width)
    base = eqx.tree_at(lambda d: d.exposure, base, jnp.full(captures, exposure))
    free = variables or (Variable("beta", 5.0, 20.0, (0,)),)
    space = DesignSpace(base, free, Limits())
    searched = design_problem(BayesError(), space, setup, np.eye(captures))
    frequencies = Quadrant(searched.best_data.frequencies.highest, count)
    return replace(searched, exact=ObjectiveData(setup, jnp.eye(captures), frequencies))


@pytest.mark.parametrize("noise", LIGHTS)
def test_no_drawn_mask_passes_it_and_some_come_near(noise):
    searched, rng = problem(noise), np.random.default_rng(0)
    found, judge = limit(searched), ShadowJudge(searched, 40)
    errors = [judge.error(drawn_mask(rng, 40)[None]) for _ in range(120)]
    assert 0 <= found.gap < 0.05
    assert 0.3 < found.above(min(errors)) < 12.0


@pytest.mark.parametrize("noise", LIGHTS)
def test_no_optimised_mask_passes_it(noise):
    """Descents over every cell, at the frequencies that the error is a sum of."""
    searched, rng = problem(noise), np.random.default_rng(1)
    judge, starts = ShadowJudge(searched, 24), (rng.random((24, 24)) * 0.3, drawn_mask(rng, 24))
    errors = [judge.error(judge.descended(start, 60)[None]) for start in starts]
    assert min(errors) < 0.8 * judge.error(starts[0][None])
    assert 0.3 < limit(searched).above(min(errors)) < 7.0


@pytest.mark.parametrize(("noise", "most"), [(PhotonNoise(50.0, 20.0), 2.0), (LIGHTS[1], 6.0)])
def test_best_of_all_masks_of_nine_cells_is_above_it(noise, most):
    """All 511 open masks of 3 × 3 cells; with 4 × 4, 65,535, in the benchmark."""
    searched = problem(noise, width=0.15)
    judge = ShadowJudge(searched, 3)
    masks = np.asarray([*itertools.product((0.0, 1.0), repeat=9)][1:]).reshape(-1, 1, 3, 3)
    assert 0 < limit(searched).above(judge.error(masks).min()) < most


def test_captures_share_the_light_of_one():
    """Several masks, each with its read noise, stay above the limit of as many."""
    rng, bright = np.random.default_rng(2), PhotonNoise(2e4, 40.0)
    one, four = limit(problem(bright)), limit(problem(bright, 4, exposure=0.25))
    assert one.error < four.error
    assert limit(problem(PhotonNoise(2e4, 0.0))).error == pytest.approx(
        limit(problem(PhotonNoise(2e4, 0.0), 4, exposure=0.25)).error, rel=1e-3
    )
    judge = ShadowJudge(problem(bright), 40)
    errors = [
        judge.error(np.stack([drawn_mask(rng, 40) for _ in range(4)]), 0.25) for _ in range(30)
    ]
    assert four.above(min(errors)) > 0.3
    free = (Variable("exposure", 0.1, 0.4, (0,)),)
    shared = problem(bright, 4, free, exposure=0.25)
    assert limit(shared).error < four.error  # as one of 0.4 and three of 0.25 shares
    with_total = DesignSpace(shared.space.base, free, Limits(exposure=1.0))
    assert limit(replace(shared, space=with_total)).error == pytest.approx(one.error, rel=1e-9)


def test_longer_distances_wider_masks_and_shorter_waves_lower_it():
    base = problem(LIGHTS[2])
    others = {
        "distance": (4.0, 5.5, (0,)),
        "width": (1.6, 1.7, ()),
        "wavelength": (4e-4, 5e-4, (0,)),
    }
    for kind in KINDS:
        for name, (lower, upper, captures) in others.items():
            space = DesignSpace(base.space.base, (Variable(name, lower, upper, captures),))
            lower_limit = limit(replace(base, space=space), masks=kind).error
            if (kind, name) == ("shadow", "wavelength"):
                assert lower_limit == limit(base, masks=kind).error
            else:
                assert lower_limit < limit(base, masks=kind).error


@pytest.mark.parametrize("noise", LIGHTS)
def test_shadows_reach_what_scipy_finds_for_the_convex_problem(noise):
    """min Σ w η/(1 + η G |H|²/(T + ρ)), |H| ≤ min(T D + δ, T), ∫δ² ≤ T - T²/A, over δ and T."""
    searched = problem(noise, count=5)
    judge, found = ShadowJudge(searched, 8), limit(searched)
    area, distance = (8 * judge.cell) ** 2, 5.0
    axis = np.asarray(searched.best_data.frequencies.axis)
    lobe = 1 / np.maximum(np.pi * 1.6 * 1.05 * axis / distance, 1)
    lobe = np.outer(lobe, lobe)
    pixel = np.sinc(0.05 * axis / distance) ** 2
    weight = np.asarray(searched.best_data.frequencies.weight) / distance**2
    gain = judge.per_noise * np.outer(pixel, pixel)

    def error(x):
        light, added = area * x[0], area * x[1:].reshape(lobe.shape)
        response = light * lobe + np.minimum(added, light * (1 - lobe))
        variance = judge.seen * light / judge.counted + (judge.read / judge.counted) ** 2
        ratio = judge.spectrum * gain * response**2 / variance
        return np.log(np.sum(judge.weight / (1 + ratio)))

    def rest(x):
        light = area * x[0]
        return (
            light - light**2 / area - np.sum(weight * (area * x[1:].reshape(lobe.shape)) ** 2)
        ) / area

    best = scipy.optimize.minimize(
        error,
        np.r_[0.2, np.full(lobe.size, 0.05)],
        bounds=[(1e-4, 1)] + [(0, 1)] * lobe.size,
        constraints={"type": "ineq", "fun": rest},
        options={"maxiter": 300, "ftol": 1e-9},
    )
    np.testing.assert_allclose(np.log(found.attained), best.fun, atol=3e-3)
    np.testing.assert_allclose(np.sum(judge.weight / (1 + found.ratio)), found.attained, rtol=1e-9)


def test_a_lens_attains_the_limit_of_phase_masks():
    """|H| of a lens is the overlap of its aperture with itself (Fresnel)."""
    searched = problem(LIGHTS[2])
    judge, found = ShadowJudge(searched, 4), limit(searched, masks="phase")
    axis = np.asarray(searched.best_data.frequencies.axis)
    along = 1.05 * (1.6 - 5e-4 * axis) * np.sinc(0.05 * axis / 5.0)
    known = judge.per_noise / judge.variance(np.ones((4, 4)), 1.0)
    left = judge.weight / (1 + judge.spectrum * known * np.outer(along, along) ** 2)
    assert 0 <= found.gap < 0.05
    assert 0 <= found.above(np.sum(left)) < 0.05


@pytest.mark.thorough
def test_zone_plates_keep_to_the_limit_of_amplitudes():
    """Which one that focuses on the sensor, a lens, nears, and passes that of shadows."""
    searched = problem(LIGHTS[2])
    focus = np.pi * 1.05 / (5e-4 * 5.0)
    least = limit(searched, masks="amplitude")
    for beta, profile in ((20.0, "cosine"), (focus / 2, "binary"), (focus, "binary")):
        one = shots([beta], 5.0, [0.3], wavelength=5e-4, width=1.6, profile=profile)
        error = float(searched.objective(one, searched.best_data))
        assert least.above(error) > 0
    assert least.above(error) < 12.0
    assert limit(searched).above(error) < 0


def test_no_fringes_pass_the_bound_of_amplitudes():
    """∫ t(ξ + s/2) t(ξ - s/2) e^{-2πjuξ} of drawn masks, transmitted along one axis."""
    searched, rng = problem(PhotonNoise(1e12, 0.0)), np.random.default_rng(3)
    found, judge = limit(searched, masks="amplitude"), ShadowJudge(searched, 4)
    axis = np.asarray(searched.best_data.frequencies.axis)
    cells, side = 1600, 1.6
    places = (np.arange(cells) - (cells - 1) / 2) * side / cells
    for number in (9, 20, 31):
        wave = np.cos(2 * np.pi * 1.05 * axis[number] / 5.0 * places + rng.uniform(0, 6))
        moved = round(5e-4 * axis[number] * cells / side)
        for mask in (wave > 0.0, wave > 0.7, rng.random(cells) < 0.4, 0.5 + 0.5 * wave):
            product = mask[moved:] * mask[: cells - moved] * 1.0
            middle = places[: cells - moved] + moved * side / cells / 2
            turned = np.exp(-2j * np.pi * 1.05 * axis[number] / 5.0 * middle)
            whole, light = (
                1.05**2 * side**2 / cells * n for n in (abs(product @ turned), sum(mask**2.0))
            )
            ratio = judge.spectrum[0, number] * judge.per_noise * judge.counted / judge.seen
            ratio *= np.sinc(0.05 * axis[number] / 5.0) ** 2 * whole**2 / light
            assert ratio <= found.ratio[0, number] * 1.05


def test_problems_without_light_or_exact_frequencies_are_refused():
    with pytest.raises(TypeError, match="give the setup PhotonNoise"):
        limit(small.problem())
    with pytest.raises(TypeError, match="Quadrant; make the problem by design_problem"):
        limit(problem().searched)
