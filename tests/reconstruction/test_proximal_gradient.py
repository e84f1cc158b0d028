"""FISTA against closed forms, slow reference solvers and ADMM; plug and play against FISTA."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from reconstruction import extremes, scenes

from helpers import compilations
from thincam_jax.reconstruction.problem import total_misfit, total_objective
from thincam_jax.reconstruction.proximal_gradient import (
    AcceleratedProximalGradient,
    FistaMethod,
    RegulariserMap,
    solve_fista,
)
from thincam_jax.reconstruction.regularisers import Sparsity, Wavelet
from thincam_jax.reconstruction.scaled_problem import ScaledProblem

few = functools.partial(solve_fista, iterations=10)


def zeros(problem):
    return jnp.zeros(problem.image_shape, problem.captures[0].dtype)


def test_the_minimum_in_closed_form_of_one_pixel_that_is_seen_by_itself():
    """With H = h and no variation, f = max(0, g/h)."""
    problem, _ = scenes.problem((1, 1), (1, 1), captures=1)
    for capture in (0.7, -0.7):
        own = eqx.tree_at(lambda p: p.captures, problem, (jnp.full((1, 1, 1), capture),))
        gain = problem.operators[0](jnp.ones((1, 1, 1, 1)))
        found = solve_fista(own, iterations=200, tolerance=1e-12)
        np.testing.assert_allclose(found.image.ravel(), max(0, capture / gain.item()), rtol=1e-6)


def without_restart(problem, iterations):
    """Objectives at every tenth iteration of FISTA as published in 2009, step by step."""
    method = FistaMethod(problem)
    proximal, scaled = method.solver.proximal, method.scaled

    @jax.jit
    def step(x, lead, t, kept):
        new, kept = proximal(lead - jax.grad(total_misfit)(lead, scaled.problem), kept)
        later = (1 + jnp.sqrt(1 + 4 * t**2)) / 2
        return new, new + (t - 1) / later * (new - x), later, kept

    state = zeros(problem), zeros(problem), jnp.asarray(1.0), proximal.start(zeros(problem))
    values = []
    for done in range(1, iterations + 1):
        state = step(*state)
        if done % 10 == 0:
            values.append(float(total_objective(state[0] * scaled.image_unit, problem)))
    return values


@pytest.mark.thorough
def test_restart_reaches_in_70_iterations_what_takes_more_than_140_without():
    problem, _ = scenes.problem(
        kernel=scenes.spots, nonnegative=False, regulariser=Sparsity(Wavelet("haar", 2))
    )
    run = solve_fista(problem, image=zeros(problem), iterations=70, tolerance=0.0)
    plain = without_restart(problem, 350)
    # The same method but for the restart, and the same minimum.
    assert run.history[1].objective == pytest.approx(plain[0], rel=1e-9)
    goal = min(plain) * (1 + 1e-12)
    assert run.history[-1].objective <= goal
    assert min(plain[:14]) > goal


@pytest.mark.thorough
def test_optimistix_drives_the_minimiser_and_differentiates_through_it():
    """dE*/dτ = R(f*), the envelope theorem, by the derivative of the solution."""
    regulariser = Sparsity(Wavelet("haar", 2))
    problem, _ = scenes.problem(
        *((9, 8), (6, 7)),
        kernel=scenes.spots,
        captures=1,
        nonnegative=False,
        regulariser=regulariser,
    )
    inside = ScaledProblem(problem).problem

    def lowest(tau):
        found = optimistix.minimise(
            total_misfit,
            AcceleratedProximalGradient(RegulariserMap(regulariser, tau, False), 1e-9),
            zeros(problem),
            args=inside,
            max_steps=256,
            throw=False,
            adjoint=optimistix.RecursiveCheckpointAdjoint(),
        ).value
        return total_misfit(found, inside) + tau * regulariser(found)[()], found

    (_, found), slope = jax.value_and_grad(lowest, has_aux=True)(jnp.asarray(3e-3))
    np.testing.assert_allclose(slope, regulariser(found), rtol=1e-5)


def test_new_values_are_not_compiled_anew():
    problem, _ = scenes.problem()
    few(problem)
    other = scenes.rescaled(problem, 3.0)
    assert compilations(lambda: few(other, tolerance=1e-3)) == 0


@pytest.mark.thorough
def test_fista_at_extremes():
    extremes.check_darkness(few)
    extremes.check_scale(few)
    extremes.check_shapes(few)
