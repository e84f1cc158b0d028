"""Plug and play: with TV the minimiser of TV, with any other denoiser the fixed point."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import extremes, scenes

from helpers import relative_l2
from thincam_jax.reconstruction import plug_and_play as module
from thincam_jax.reconstruction.plug_and_play import VariationDenoiser, solve_plug_and_play
from thincam_jax.reconstruction.proximal import solve_proximal
from thincam_jax.reconstruction.scaled import scaled_problem


class Smoother(eqx.Module):
    """Each pixel drawn to the mean of its four neighbours, by a part `strength`: linear."""

    strength: jax.Array

    def __call__(self, image):
        around = sum(jnp.roll(image, s, a) for a in (-1, -2) for s in (-1, 1)) / 4
        return image + self.strength.astype(image.dtype) * (around - image)


SCHEMES = ["proximal", "admm"]


@pytest.mark.parametrize("scheme", SCHEMES)
def test_with_a_tv_denoiser_it_is_the_minimiser_of_tv(scheme):
    problem, _ = scenes.problem(kernel=scenes.spots, tau=3e-3)
    minimiser = solve_proximal(problem, iterations=500, tolerance=1e-8, inner=30)
    denoiser = VariationDenoiser(problem, iterations=300)
    found = solve_plug_and_play(problem, denoiser, scheme=scheme, tolerance=1e-6)
    assert found.status == "converged"
    assert relative_l2(found.image, minimiser.image) < 1e-3
    assert found.history[-1].objective < 1e-4 * found.history[0].objective


@pytest.mark.parametrize("scheme", SCHEMES)
def test_with_a_linear_denoiser_it_is_the_solution_of_a_linear_system(scheme):
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
    curvature = float(scaled_problem(problem).curvature)
    left = np.eye(count) - smooth @ (np.eye(count) - normal / curvature)
    wanted = np.linalg.solve(left, smooth @ right / curvature)
    found = solve_plug_and_play(problem, denoiser, scheme=scheme, iterations=800, tolerance=1e-9)
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


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.thorough
def test_it_stands_extremes(scheme):
    solve = functools.partial(
        solve_plug_and_play, denoiser=Smoother(jnp.asarray(0.3)), scheme=scheme, iterations=10
    )
    extremes.check_darkness(solve)
    extremes.check_scale(solve)
    extremes.check_shapes(solve)


def test_new_values_are_not_compiled_anew_and_no_number_has_a_status():
    problem, _ = scenes.problem()
    solve = functools.partial(solve_plug_and_play, iterations=10)
    solve(problem, Smoother(jnp.asarray(0.3)))
    before = module._look._cached._cache_size()
    solve(scenes.rescaled(problem, 2.0), Smoother(jnp.asarray(0.2)))
    assert module._look._cached._cache_size() == before
    broken = (problem.captures[0].at[0, 0, 0].set(jnp.nan), problem.captures[1])
    broken = eqx.tree_at(lambda p: p.captures, problem, broken)
    start = jnp.zeros(problem.image_shape)
    outcome = solve(broken, Smoother(jnp.asarray(0.3)), image=start)
    assert outcome.status == "non_finite" and bool(jnp.isfinite(outcome.image).all())
