"""Ridge regression: against a dense solver, in float32, with weights, extremes."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import extremes, scenes

from helpers import relative_l2
from thincam_jax.reconstruction import ridge as module
from thincam_jax.reconstruction.ridge import solve_ridge

few = functools.partial(solve_ridge, ridge=0.1)


def dense(problem, ridge, mean):
    """The image by normal equations, written out."""
    count = int(np.prod(problem.image_shape))
    pixels = jnp.eye(count).reshape(count, *problem.image_shape)
    left, right = ridge * np.eye(count), ridge * np.ravel(mean)
    for o, g, w in zip(problem.operators, problem.captures, problem.weights, strict=True):
        matrix = np.asarray(o(pixels)).reshape(count, -1).T
        weight = np.broadcast_to(w, g.shape).ravel()
        left += matrix.T @ (weight[:, None] * matrix)
        right += matrix.T @ (weight * np.ravel(g))
    return np.linalg.solve(left, right).reshape(problem.image_shape)


@pytest.mark.parametrize("more", [{}, {"channels": 2, "planes": 2}], ids=["grey", "planes"])
def test_it_is_the_dense_solution(more):
    problem, _ = scenes.problem((11, 9), (7, 8), **more)
    weights = tuple(
        jnp.asarray(np.random.default_rng(3).integers(0, 3, c.shape).astype(float))
        for c in problem.captures
    )
    problem = eqx.tree_at(lambda p: p.weights, problem, weights)
    for ridge in (1e-3, 1.0):
        mean = jnp.asarray(np.random.default_rng(1).normal(size=problem.image_shape))
        found = solve_ridge(problem, ridge=ridge, mean=mean, tolerance=1e-9, iterations=5000)
        assert found.status == "converged"
        np.testing.assert_allclose(found.image, dense(problem, ridge, mean), atol=1e-6)


def test_a_strong_ridge_gives_the_mean_and_a_weak_one_the_truth():
    problem, truth = scenes.problem((20, 21), (9, 8), noise=0.0, kernel=scenes.spots)
    mean = jnp.full(problem.image_shape, 0.25)
    np.testing.assert_allclose(few(problem, ridge=1e8, mean=mean).image, 0.25, atol=1e-5)
    exact = few(problem, ridge=1e-9, mean=mean, tolerance=1e-10, iterations=2000)
    assert relative_l2(exact.image, truth) < 1e-4


def test_too_few_iterations_have_a_status_and_yet_a_lower_objective():
    problem, _ = scenes.problem()
    outcome = few(problem, iterations=3)
    assert outcome.status == "iterations_exhausted" and outcome.iterations == 3
    assert outcome.history[-1].objective < 0.3 * outcome.history[0].objective


def test_float32_of_many_pixels_does_not_break_down():
    """lineax takes curvatures below 100·eps·(unknowns) for zero unless they are scaled."""
    problem, _ = scenes.problem((150, 160), (140, 131), captures=1)
    found = solve_ridge(scenes.single(problem), ridge=10.0, tolerance=1e-4)
    assert found.status == "converged"
    double = solve_ridge(problem, ridge=10.0, tolerance=1e-6)
    assert relative_l2(found.image, double.image) < 1e-2


@pytest.mark.thorough
def test_it_stands_extremes():
    extremes.check_darkness(few)
    extremes.check_scale(few)
    extremes.check_shapes(few)


def test_new_values_are_not_compiled_anew_and_wrong_ones_are_refused():
    problem, _ = scenes.problem()
    few(problem)
    before = module._solve._cache_size()
    few(scenes.rescaled(problem, 2.0), ridge=0.3, tolerance=1e-3)
    assert module._solve._cache_size() == before
    with pytest.raises(ValueError, match="ridge"):
        few(problem, ridge=0.0)


def test_no_number_has_a_status():
    problem, _ = scenes.problem()
    broken = (problem.captures[0].at[0, 0, 0].set(jnp.nan), problem.captures[1])
    broken = eqx.tree_at(lambda p: p.captures, problem, broken)
    outcome = few(broken, mean=jnp.zeros(problem.image_shape))
    assert outcome.status == "non_finite" and bool(jnp.isfinite(outcome.image).all())
