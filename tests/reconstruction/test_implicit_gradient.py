"""Proximal gradients by jaxopt: the minimum of FISTA, and derivatives of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction import scenes

import thincam_jax as tc
from helpers import finite_difference, relative_l2
from thincam_jax.reconstruction.fista import solve_fista
from thincam_jax.reconstruction.regularisers import Cosines, Sparsity


def zeros(problem):
    return jnp.zeros(problem.image_shape, problem.captures[0].dtype)


@pytest.mark.thorough
def test_it_finds_what_fista_finds():
    problem, _ = scenes.problem(kernel=scenes.spots, tau=3e-3)
    own = solve_fista(problem, iterations=60, tolerance=0.0, inner=30)
    image = tc.implicit_proximal_gradient(problem, zeros(problem), iterations=60, inner=200)
    assert relative_l2(image, own.image) < 1e-2


def sparse(tau):
    """A small problem with few cosines, and its scene."""
    return scenes.problem(
        *((9, 8), (6, 7)),
        kernel=scenes.spots,
        captures=1,
        tau=tau,
        nonnegative=False,
        regulariser=Sparsity(Cosines()),
    )


@pytest.mark.thorough
def test_with_a_proximal_map_in_closed_form_it_is_the_minimum_of_fista():
    problem, _ = sparse(0.05)
    own = solve_fista(problem, iterations=800, tolerance=1e-10)
    image = tc.implicit_proximal_gradient(problem, zeros(problem), iterations=2000, tolerance=1e-12)
    assert relative_l2(image, own.image) < 1e-6


def test_the_implicit_derivative_is_that_of_differences():
    problem, truth = sparse(0.05)

    @jax.jit
    def error(tau):
        own = scenes.absolute(problem, tau)
        image = tc.implicit_proximal_gradient(own, zeros(problem), iterations=2000, tolerance=1e-12)
        return jnp.sum((image - truth) ** 2)

    tau = jnp.asarray(0.05)
    wanted = finite_difference(error, tau, jnp.asarray(1.0), 1e-5)
    np.testing.assert_allclose(jax.grad(error)(tau), wanted, rtol=1e-4)


@pytest.mark.thorough
@pytest.mark.parametrize("factor", [1e-8, 1e8])
def test_it_scales_with_the_captures_in_float32(factor):
    problem = scenes.single(scenes.problem()[0])
    plain = tc.implicit_proximal_gradient(problem, zeros(problem), iterations=10)
    other = tc.implicit_proximal_gradient(
        scenes.rescaled(problem, factor), zeros(problem), iterations=10
    )
    assert other.dtype == jnp.float32
    assert relative_l2(np.asarray(other) / factor, plain) < 2e-3
    dark = scenes.rescaled(problem, 0.0)
    assert (
        float(jnp.abs(tc.implicit_proximal_gradient(dark, zeros(problem), iterations=10)).max())
        == 0
    )
