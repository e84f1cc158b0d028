"""ADMM-TV in fewer iterations: relaxation, balanced penalties, Anderson acceleration."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tifffile
from reconstruction import extremes, scenes

import thincam_jax as tc
from helpers import relative_l2, shared_data
from thincam_jax.reconstruction import _jaxopt, psf_problem
from thincam_jax.reconstruction._jaxopt import AndersonAdmm, Mixing
from thincam_jax.reconstruction.admm import step
from thincam_jax.reconstruction.drive import drive
from thincam_jax.reconstruction.regularised import Options, minimise
from thincam_jax.reconstruction.tv_method import AdmmTotalVariation


def zeros(problem):
    return jnp.zeros(problem.image_shape, problem.captures[0].dtype)


def run(method, problem, iterations, *, adapt_until=0, tolerance=0.0):
    return drive(
        method,
        zeros(problem),
        iterations=iterations,
        tolerance=tolerance,
        adapt_until=adapt_until,
    )


def needed(outcome, goal):
    """Iterations to an objective, to a multiple of ten; infinite if it was not reached."""
    reached = (p.iteration for p in outcome.history if p.objective <= goal * (1 + 1e-6))
    return next(reached, np.inf)


def of_500_plain_iterations(problem):
    return run(AdmmTotalVariation(problem), problem, 500).history[-1].objective


def hand(bin_by):
    """The measured capture of a hand through a diffuser, binned."""
    folder = shared_data("diffusercam-hand")
    psf, raw = (
        tifffile.imread(folder / name).astype(float)
        for name in ("psf_sample.tif", "rawdata_hand_sample.tif")
    )
    background = psf[5:15, 5:15].mean()
    rows, columns = (n // bin_by for n in psf.shape)
    psf, raw = (
        np.maximum(i - background, 0)
        .reshape(rows, bin_by, columns, bin_by)
        .mean((1, 3))
        .astype(np.float32)
        for i in (psf, raw)
    )
    return psf_problem(jnp.asarray(raw[None, None]), jnp.asarray((psf / psf.sum())[None]), tau=2.0)


@pytest.mark.parametrize(
    "bin_by, acceleration, most",
    [
        (8, "none", 100),
        pytest.param(4, "none", 130, marks=pytest.mark.thorough),
        pytest.param(8, "anderson", 100, marks=pytest.mark.thorough),
    ],
)
def test_what_500_plain_iterations_reach_in_a_quarter_of_them(bin_by, acceleration, most):
    """A measured capture, with the relaxation and the balance of `reconstruct`: 80, 110 and 80."""
    problem = hand(bin_by)
    how = Options("admm_tv", 150, 0.0, 1.8, None, None, acceleration=acceleration)
    outcome = minimise(problem, how, even_start=False).outcome
    assert needed(outcome, of_500_plain_iterations(problem)) <= most


def test_it_is_an_option_of_reconstruct():
    """Another way to the same image: the same to the first look, before any point is mixed."""
    problem, truth = scenes.problem(captures=1)
    kernel = jnp.asarray(scenes.zone_plate((25, 27)))[None]
    how = {"method": "admm_tv", "relaxation": 1.0, "iterations": 60, "tolerance": 0.0}
    plain, mixed = (
        tc.reconstruct(problem.captures[0][0][None], kernel, acceleration=a, **how)
        for a in ("none", "anderson")
    )
    assert mixed.history[1].objective == pytest.approx(plain.history[1].objective, rel=1e-9)
    assert mixed.history[-1].objective != plain.history[-1].objective
    assert mixed.history[-1].objective < plain.history[-1].objective * (1 + 1e-3)


@pytest.mark.thorough
def test_anderson_alone_needs_60_percent_of_the_plain_iterations():
    """Penalties and relaxation as they are: it is Anderson that does it."""
    for problem in (
        hand(8),
        scenes.problem(channels=3)[0],
        scenes.problem(channels=3, kernel=scenes.spots)[0],
    ):
        goal = of_500_plain_iterations(problem)
        assert needed(run(AndersonAdmm(problem), problem, 300), goal) <= 300


@pytest.mark.thorough
def test_with_balance_it_needs_a_fifth_on_a_zone_plate_in_colour():
    problem, _ = scenes.problem(channels=3)
    goal = of_500_plain_iterations(problem)
    outcome = run(AndersonAdmm(problem), problem, 100, adapt_until=30)
    assert needed(outcome, goal) <= 100


@pytest.mark.thorough
def test_its_fixed_point_is_the_minimiser_of_plain_admm():
    problem, _ = scenes.problem((9, 12), (7, 8), kernel=scenes.spots, tau=3e-3)
    plain, mixed = (
        run(kind(problem), problem, 8000, tolerance=1e-10)
        for kind in (AdmmTotalVariation, AndersonAdmm)
    )
    assert plain.status == mixed.status == "converged"
    assert relative_l2(mixed.image, plain.image) < 1e-6
    assert mixed.iterations < 0.8 * plain.iterations


@pytest.mark.thorough
def test_before_the_history_is_full_it_is_admm():
    """And the residuals told are those of ADMM."""
    problem, _ = scenes.problem()
    plain = AdmmTotalVariation(problem, relaxation=1.4)
    mixed = AndersonAdmm(problem, relaxation=1.4)
    first = jnp.full(problem.image_shape, 0.3)
    state, residuals = plain.look(plain.advance(plain.start(first), 9))
    other, found = mixed.look(mixed.advance(mixed.start(first), 9))
    np.testing.assert_allclose(mixed.image(other), plain.image(state), atol=1e-12)
    np.testing.assert_allclose(found.parts, residuals.parts, rtol=1e-9)
    np.testing.assert_allclose(found[:2], residuals[:2], rtol=1e-9)
    # and from then on it is not
    state, other = plain.advance(state, 9), mixed.advance(other, 9)
    assert relative_l2(mixed.image(other), plain.image(state)) > 1e-4


def test_a_mixture_that_is_worse_is_thrown_away():
    """With no growth allowed at all, the last point stays and the history begins anew."""
    problem, _ = scenes.problem()
    mixed = AndersonAdmm(problem, mixing=Mixing(history=2, growth=1e-3, wait=0))
    start = mixed.start(zeros(problem))
    once = mixed.advance(start, 1)
    kept = jax.tree.map(jnp.copy, once.weighed)
    again = mixed.advance(once, 1)
    jax.tree.map(np.testing.assert_array_equal, again.weighed, kept)
    assert int(again.inside.iter_num) == 0


@pytest.mark.thorough
def test_a_history_begins_anew_with_other_penalties_and_keeps_the_image():
    problem, _ = scenes.problem()
    method = AndersonAdmm(problem)
    state, residuals = method.look(method.advance(method.start(zeros(problem)), 9))
    before = method.image(state)
    uneven = residuals._replace(parts=((4.0, 1.0), (1.0, 100.0), (1.0, 1.0)))
    other, changed = method.adapt(state, uneven)
    assert isinstance(other, AndersonAdmm)
    np.testing.assert_allclose(other.image(changed), before, atol=1e-12)
    assert int(changed.inside.iter_num) == -method.mixing.wait
    assert float(other.plain.penalties.data / method.plain.penalties.data) == pytest.approx(2.0)
    even = residuals._replace(parts=((1.0, 1.0),) * 3)
    assert method.adapt(state, even)[0] is method


def test_the_residual_it_minimises_is_in_the_norm_of_the_penalties():
    problem, _ = scenes.problem()
    method = AndersonAdmm(problem)
    plain = method.plain
    point = plain.start(jnp.full(problem.image_shape, 0.3))
    after = step(plain.splitting, plain.penalties, plain.relaxation, point)
    moved = jax.tree.map(lambda a, b: jnp.sum((a - b) ** 2), after, point)
    parts = (sum(moved.data), sum(moved.slopes), moved.image)
    weights = jax.tree.leaves(plain.penalties)
    wanted = sum(w * p for w, p in zip(weights, parts, strict=True))
    state = method.advance(method.start(jnp.full(problem.image_shape, 0.3)), 1)
    assert float(state.inside.error) == pytest.approx(float(wanted) ** 0.5, rel=1e-12)


def few(problem):
    return run(AndersonAdmm(problem, relaxation=1.5), problem, 40, adapt_until=10)


@pytest.mark.thorough
def test_new_values_are_not_compiled_anew():
    problem, _ = scenes.problem()
    programs = (_jaxopt._begin_mixing, _jaxopt._advance_mixing, _jaxopt._look_mixing)
    few(problem)
    sizes = [program._cache_size() for program in programs]
    few(scenes.rescaled(problem, 3.0))
    run(AndersonAdmm(problem, relaxation=1.1), problem, 20)
    assert [program._cache_size() for program in programs] == sizes


@pytest.mark.thorough
def test_single_precision_stays_and_is_near_to_double():
    problem, _ = scenes.problem()
    value, expected = few(scenes.single(problem)), few(problem)
    assert value.image.dtype == jnp.float32
    assert relative_l2(value.image, expected.image) < 1e-2
    method = AndersonAdmm(scenes.single(problem))
    state = method.advance(method.start(value.image), 9)
    kinds = {
        leaf.dtype for leaf in jax.tree.leaves(state) if jnp.issubdtype(leaf.dtype, jnp.floating)
    }
    assert kinds == {jnp.dtype("float32")}


def test_captures_of_no_number_have_a_status():
    problem, _ = scenes.problem()
    broken = (problem.captures[0].at[0, 0, 0].set(jnp.nan), problem.captures[1])
    outcome = few(eqx.tree_at(lambda p: p.captures, problem, broken))
    assert outcome.status == "non_finite"


@pytest.mark.thorough
def test_it_stands_extremes():
    extremes.check_darkness(few)
    extremes.check_scale(few)
    extremes.check_shapes(few)
