"""Proximal gradients: the minimum, restart, the three backends, derivatives, extremes."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from reconstruction import extremes, scenes

from helpers import finite_difference, relative_l2
from thincam_jax.reconstruction import proximal as module
from thincam_jax.reconstruction._jaxopt import implicit_minimiser
from thincam_jax.reconstruction.drive import drive
from thincam_jax.reconstruction.proximal import ProximalGradient, composite, solve_proximal
from thincam_jax.reconstruction.proximal_minimiser import AcceleratedProximal, total_misfit
from thincam_jax.reconstruction.sparsity import Cosines, Sparsity
from thincam_jax.reconstruction.tv_method import AdmmTotalVariation
from thincam_jax.reconstruction.wavelet import Wavelet

few = functools.partial(solve_proximal, iterations=10)


def zeros(problem):
    return jnp.zeros(problem.image_shape, problem.captures[0].dtype)


@pytest.mark.thorough
def test_it_finds_the_minimum_that_admm_finds():
    problem, truth = scenes.problem(kernel=scenes.spots, tau=3e-3)
    admm = drive(
        AdmmTotalVariation(problem),
        zeros(problem),
        iterations=1500,
        tolerance=1e-9,
        adapt_until=200,
    )
    lowest = min(p.objective for p in admm.history)
    found = solve_proximal(problem, iterations=400, tolerance=1e-7, inner=30)
    assert found.status == "converged"
    assert abs(found.history[-1].objective / lowest - 1) < 1e-5
    assert relative_l2(found.image, admm.image) < 3e-3
    assert relative_l2(found.image, truth) < 0.6 * relative_l2(zeros(problem) + truth.mean(), truth)


def test_the_minimum_in_closed_form_of_one_pixel_that_is_seen_by_itself():
    """With H = h and no variation, f = max(0, g/h)."""
    problem, _ = scenes.problem((1, 1), (1, 1), captures=1)
    for capture in (0.7, -0.7):
        own = eqx.tree_at(lambda p: p.captures, problem, (jnp.full((1, 1, 1), capture),))
        gain = problem.operators[0](jnp.ones((1, 1, 1, 1)))
        found = solve_proximal(own, iterations=200, tolerance=1e-12)
        np.testing.assert_allclose(found.image.ravel(), max(0, capture / gain.item()), rtol=1e-6)


def test_restart_reaches_in_150_iterations_what_takes_500_without():
    problem, _ = scenes.problem(kernel=scenes.spots, nonnegative=False)
    runs = [
        drive(
            ProximalGradient(problem, regulariser=Sparsity(Wavelet("haar", 2)), restart=restart),
            zeros(problem),
            iterations=count,
            tolerance=0.0,
        )
        for restart, count in ((False, 500), (True, 150))
    ]
    goal = runs[0].history[-1].objective
    first = next(p.iteration for p in runs[1].history if p.objective <= goal)
    assert first <= 150
    # It is the restart that does it.
    plain = next(p.iteration for p in runs[0].history if p.objective <= goal)
    assert plain > 2 * first


@pytest.mark.parametrize("nonnegative", [False, True])
@pytest.mark.parametrize("basis", [Cosines(), Wavelet("haar", 2)], ids=["cosines", "haar"])
@pytest.mark.thorough
def test_no_image_beside_a_sparse_minimum_is_better(basis, nonnegative):
    problem, _ = scenes.problem(kernel=scenes.spots, tau=3e-2, nonnegative=nonnegative)
    regulariser = Sparsity(basis)
    found = solve_proximal(
        problem, regulariser=regulariser, iterations=400, tolerance=1e-8, inner=30
    ).image
    lowest = composite(problem, regulariser, found)
    rng = np.random.default_rng(5)
    for size in (1e-4, 1e-3, 1e-2):
        for _ in range(10):
            other = found + size * jnp.asarray(rng.normal(size=found.shape))
            other = jnp.maximum(other, 0) if nonnegative else other
            assert composite(problem, regulariser, other) > lowest
    assert not nonnegative or float(found.min()) >= 0
    (details,) = regulariser.analyse(found)
    if not nonnegative:
        assert 0.2 < float(jnp.mean(details == 0)) or float(jnp.mean(jnp.abs(details) < 1e-9)) > 0.2


@pytest.mark.thorough
def test_the_backends_do_the_same():
    problem, _ = scenes.problem(kernel=scenes.spots, tau=3e-3)
    how = {"iterations": 60, "tolerance": 0.0, "inner": 30}
    own, optimistix_ = (solve_proximal(problem, backend=b, **how) for b in ("own", "optimistix"))
    jaxopt = solve_proximal(problem, backend="jaxopt", **(how | {"inner": 200}))
    np.testing.assert_allclose(optimistix_.image, own.image, atol=1e-10)
    assert abs(jaxopt.history[-1].objective / own.history[-1].objective - 1) < 1e-3
    assert relative_l2(jaxopt.image, own.image) < 1e-2
    assert optimistix_.status == own.status == jaxopt.status == "iterations_exhausted"
    assert solve_proximal(problem, backend="optimistix", tolerance=1e-4).status == "converged"


@pytest.mark.thorough
def test_optimistix_drives_the_minimiser_and_differentiates_through_it():
    """dE*/dτ = R(f*), the envelope theorem, by the derivative of the solution."""
    problem, _ = scenes.problem((9, 8), (6, 7), kernel=scenes.spots, captures=1, nonnegative=False)
    method = ProximalGradient(problem, regulariser=Sparsity(Wavelet("haar", 2)))
    inside = method.scaled.problem

    def lowest(tau):
        step = eqx.tree_at(lambda s: s.tau, method.step, tau)
        found = optimistix.minimise(
            total_misfit,
            AcceleratedProximal(step, rtol=1e-9, atol=0.0),
            jnp.zeros(problem.image_shape),
            args=inside,
            max_steps=256,
            throw=False,
            adjoint=optimistix.RecursiveCheckpointAdjoint(),
        ).value
        return total_misfit(found, inside) + tau * step.regulariser(found), found

    (_, found), slope = jax.value_and_grad(lowest, has_aux=True)(jnp.asarray(3e-3))
    np.testing.assert_allclose(slope, method.step.regulariser(found), rtol=1e-5)


def test_the_implicit_derivative_is_that_of_differences():
    problem, truth = scenes.problem(
        (9, 8), (6, 7), kernel=scenes.spots, captures=1, tau=0.05, nonnegative=False
    )
    regulariser = Sparsity(Cosines())

    def error(tau):
        own = eqx.tree_at(lambda p: p.tau, problem, tau)
        image = implicit_minimiser(
            own, regulariser, zeros(problem), iterations=2000, tolerance=1e-12
        )
        return jnp.sum((image - truth) ** 2)

    error = jax.jit(error)
    tau = jnp.asarray(0.05)
    wanted = finite_difference(error, tau, jnp.asarray(1.0), 1e-5)
    np.testing.assert_allclose(jax.grad(error)(tau), wanted, rtol=1e-4)


def test_new_values_are_not_compiled_anew():
    problem, _ = scenes.problem()
    few(problem)
    before = module._advance._cache_size(), module._look._cache_size()
    few(scenes.rescaled(problem, 3.0), tolerance=1e-3)
    assert (module._advance._cache_size(), module._look._cache_size()) == before


@pytest.mark.parametrize("backend", ["own", "optimistix", "jaxopt"])
@pytest.mark.thorough
def test_it_stands_extremes(backend):
    solve = functools.partial(few, backend=backend)
    extremes.check_darkness(solve)
    extremes.check_scale(solve)
    if backend == "own":
        extremes.check_shapes(solve)


def test_progress_is_told_and_a_callback_can_stop():
    problem, _ = scenes.problem()
    seen = []

    def stop(progress):
        seen.append(progress)
        return progress.iteration >= 20

    outcome = solve_proximal(problem, callback=stop, iterations=100)
    assert outcome.status == "stopped" and outcome.iterations == 20
    assert [p.iteration for p in seen] == [10, 20]
    assert seen[1].objective < seen[0].objective
    with pytest.raises(ValueError, match="calls no callback"):
        solve_proximal(problem, backend="optimistix", callback=stop)


def test_a_capture_of_no_number_has_a_status():
    problem, _ = scenes.problem()
    broken = (problem.captures[0].at[0, 0, 0].set(jnp.nan), problem.captures[1])
    broken = eqx.tree_at(lambda p: p.captures, problem, broken)
    for backend in ("own", "optimistix"):
        outcome = few(broken, image=zeros(problem), backend=backend)
        assert outcome.status == "non_finite"
        assert bool(jnp.isfinite(outcome.image).all())
