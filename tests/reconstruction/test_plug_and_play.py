"""Plug and play: with TV the minimiser of TV, with any other denoiser the fixed point."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import extremes, scenes

from helpers import quick, relative_l2
from thincam_jax.reconstruction import drive as module
from thincam_jax.reconstruction import plug_and_play
from thincam_jax.reconstruction.fista import solve_fista
from thincam_jax.reconstruction.plug_and_play import RegulariserDenoiser, solve_plug_and_play
from thincam_jax.reconstruction.regularisers import Cosines, Sparsity
from thincam_jax.reconstruction.scaled import ScaledProblem


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
    denoiser = RegulariserDenoiser(problem, iterations=300)
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
def test_it_stands_extremes():
    solve = functools.partial(
        solve_plug_and_play, denoiser=Smoother(jnp.asarray(0.3)), iterations=10
    )
    extremes.check_darkness(solve)
    extremes.check_scale(solve)
    extremes.check_shapes(solve)


def test_new_values_are_not_compiled_anew_and_nan_has_a_status():
    problem, _ = scenes.problem()
    solve = functools.partial(solve_plug_and_play, iterations=10)
    solve(problem, Smoother(jnp.asarray(0.3)))
    programs = (module._start, module._advance, module._image, plug_and_play._distance)
    before = [program._cached._cache_size() for program in programs]
    solve(scenes.rescaled(problem, 2.0), Smoother(jnp.asarray(0.2)))
    assert [program._cached._cache_size() for program in programs] == before
    broken = (problem.captures[0].at[0, 0, 0].set(jnp.nan), problem.captures[1])
    broken = eqx.tree_at(lambda p: p.captures, problem, broken)
    start = jnp.zeros(problem.image_shape)
    outcome = solve(broken, Smoother(jnp.asarray(0.3)), image=start)
    assert outcome.status == "non_finite" and bool(jnp.isfinite(outcome.image).all())
