"""FISTA against closed forms, slow reference solvers and ADMM; plug and play against FISTA."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from reconstruction import extremes, scenes

from helpers import quick, relative_l2
from thincam_jax.reconstruction import iterate as module
from thincam_jax.reconstruction import proximal_gradient
from thincam_jax.reconstruction.iterate import Schedule, iterate
from thincam_jax.reconstruction.problem import ScaledProblem, total_misfit, total_objective
from thincam_jax.reconstruction.proximal_gradient import (
    AcceleratedProximalGradient,
    FistaMethod,
    RegulariserMap,
    solve_fista,
    solve_plug_and_play,
)
from thincam_jax.reconstruction.regularisers import Cosines, Sparsity, Wavelet, denoise
from thincam_jax.reconstruction.splittings import admm_method

few = functools.partial(solve_fista, iterations=10)


def zeros(problem):
    return jnp.zeros(problem.image_shape, problem.captures[0].dtype)


def test_it_finds_the_minimum_that_admm_finds():
    problem, truth = scenes.problem((12, 14), (8, 9), kernel=scenes.spots)
    settings = {"iterations": 600, "tolerance": 1e-7}
    admm = iterate(admm_method(problem), zeros(problem), Schedule(adapt_until=200, **settings))
    found = solve_fista(problem, **settings)
    assert admm.status == found.status == "converged"
    assert found.history[-1].objective == pytest.approx(admm.history[-1].objective, rel=1e-6)
    assert relative_l2(found.image, admm.image) < 1e-5
    assert relative_l2(found.image, truth) < 0.6 * relative_l2(zeros(problem) + truth.mean(), truth)


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


def test_optimistix_in_one_loop_gives_the_image_of_steps_from_outside():
    problem, _ = scenes.problem(kernel=scenes.spots, tau=3e-3)
    own = solve_fista(problem, image=zeros(problem), iterations=60, tolerance=0.0)
    method = FistaMethod(problem)
    loop = optimistix.minimise(
        total_misfit,
        method.solver,
        zeros(problem),
        args=method.arguments,
        max_steps=60,
        throw=False,
    )
    assert int(loop.stats["num_steps"]) == 60 and own.status == "iterations_exhausted"
    np.testing.assert_allclose(method.image_of(loop.value), own.image, atol=1e-10)
    solver = AcceleratedProximalGradient(method.solver.proximal, 1e-4)
    ended = optimistix.minimise(total_misfit, solver, zeros(problem), args=method.arguments)
    assert solve_fista(problem, image=zeros(problem), tolerance=1e-4).status == "converged"
    near = method.image_of(ended.value)
    assert relative_l2(near, own.image) < 0.1


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


def compilations():
    """Of the programs that `iterate` runs of any method."""
    programs = (module._start, module._advance, module._image)
    return [program._cached._cache_size() for program in programs]


def test_new_values_are_not_compiled_anew():
    problem, _ = scenes.problem()
    few(problem)
    before = compilations()
    few(scenes.rescaled(problem, 3.0), tolerance=1e-3)
    assert compilations() == before


@pytest.mark.thorough
def test_fista_at_extremes():
    extremes.check_darkness(few)
    extremes.check_scale(few)
    extremes.check_shapes(few)


class Smoother(eqx.Module):
    """Each pixel drawn to the mean of its four neighbours, by a part `strength`: linear."""

    strength: jax.Array

    def __call__(self, image):
        around = sum(jnp.roll(image, s, a) for a in (-1, -2) for s in (-1, 1)) / 4
        return image + self.strength.astype(image.dtype) * (around - image)


@pytest.mark.parametrize(
    "regulariser", quick([None, Sparsity(Cosines())], 0), ids=["tv", "cosines"]
)
def test_with_the_denoiser_of_a_regulariser_it_is_its_minimiser(regulariser):
    # Of cosines the proximal map is in closed form then, of total variation it is not.
    how = {"regulariser": regulariser, "nonnegative": regulariser is None}
    problem, _ = scenes.problem(kernel=scenes.spots, tau=3e-3, **how)
    minimiser = solve_fista(problem, iterations=500, tolerance=1e-8, inner=30)
    denoiser = eqx.Partial(
        denoise,
        step=problem.absolute_tau / ScaledProblem(problem).curvature,
        regulariser=problem.regulariser,
        nonnegative=problem.nonnegative,
        iterations=300,
    )
    found = solve_plug_and_play(problem, denoiser, iterations=400)
    assert found.status == "converged"
    assert relative_l2(found.image, minimiser.image) < 1e-3
    assert found.history[-1].objective < 1e-4 * found.history[0].objective


def test_with_a_linear_denoiser_it_is_the_solution_of_a_linear_system():
    """f = D(f − Aᵀ(Af − g)/L), dense."""
    problem, _ = scenes.problem((9, 8), (6, 7), nonnegative=False)
    denoiser = Smoother(jnp.asarray(0.3))
    count = int(np.prod(problem.image_shape))
    pixels = jnp.eye(count).reshape(count, *problem.image_shape)
    smooth = np.asarray(denoiser(pixels)).reshape(count, -1).T
    normal, right = np.zeros((count, count)), np.zeros(count)
    for operator, capture in zip(problem.operators, problem.captures, strict=True):
        matrix = np.asarray(operator(pixels)).reshape(count, -1).T
        normal += matrix.T @ matrix
        right += matrix.T @ np.ravel(capture)
    curvature = float(ScaledProblem(problem).curvature)
    left = np.eye(count) - smooth @ (np.eye(count) - normal / curvature)
    wanted = np.linalg.solve(left, smooth @ right / curvature)
    found = solve_plug_and_play(problem, denoiser, iterations=800)
    np.testing.assert_allclose(found.image.ravel(), wanted, atol=1e-4 * np.abs(wanted).max())


def test_the_denoiser_sees_images_in_units_of_the_brightness():
    """One that clips at 1 cuts the image at the brightness given."""
    problem, truth = scenes.problem(kernel=scenes.spots, noise=0.0)
    assert float(truth.max()) > 0.7
    for brightness in (0.7, 7.0):
        found = solve_plug_and_play(problem, clipped, brightness=brightness, iterations=40)
        highest = float(found.image.max())
        assert (abs(highest - 0.7) < 1e-6) if brightness == 0.7 else highest > 0.9


def clipped(image):
    return jnp.minimum(image, 1)


@pytest.mark.thorough
def test_plug_and_play_at_extremes():
    solve = functools.partial(
        solve_plug_and_play, denoiser=Smoother(jnp.asarray(0.3)), iterations=10
    )
    extremes.check_darkness(solve)
    extremes.check_scale(solve)
    extremes.check_shapes(solve)


def test_other_denoisers_are_not_compiled_anew():
    problem, _ = scenes.problem()
    solve = functools.partial(solve_plug_and_play, iterations=10)
    solve(problem, Smoother(jnp.asarray(0.3)))
    programs = (module._start, module._advance, module._image, proximal_gradient._distance)
    before = [program._cached._cache_size() for program in programs]
    solve(scenes.rescaled(problem, 2.0), Smoother(jnp.asarray(0.2)))
    assert [program._cached._cache_size() for program in programs] == before
