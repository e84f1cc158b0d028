"""Minimisers as differentiable functions: fixed points of ADMM, and proximal gradients."""

import functools
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from reconstruction import scenes

import thincam_jax as tc
from helpers import AS_IN_USE, count_traces, finite_difference, relative_l2
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import kernel_grid
from thincam_jax.reconstruction.admm import Penalties
from thincam_jax.reconstruction.implicit_gradient import (
    NeumannSeries,
    implicit_proximal_gradient,
    solve_fixed_point,
)
from thincam_jax.reconstruction.regularisers import Cosines, Sparsity
from thincam_jax.reconstruction.splittings import splitting_of
from thincam_jax.units import nm

BETA, DISTANCE, TAU = 50.0, 4.0, 0.05
SENSOR, FIELD = tc.Sensor((24, 32), 0.05), (12, 16)


def picture():
    """Squares of two brightnesses in a disc, on a dark ground."""
    y, x = np.mgrid[: FIELD[0], : FIELD[1]]
    squares = (y // 7 + x // 9) % 2 * 0.7 + 0.2
    return jnp.asarray(squares * (np.hypot(y - 6, x - 8) < 5.4))[None, None]


def camera_operator(beta, distance, dtype=jnp.float64):
    """The difference of two captures of opposite phase through a zone aperture 0.84 mm wide."""
    plates = [tc.FresnelZoneAperture(beta, phase, width=0.84) for phase in (0.0, math.pi)]
    first, second = (
        tc.psf(
            tc.LenslessCamera(plate, SENSOR, distance).on_grid(kernel_grid(SENSOR.grid, FIELD)),
            wavelength=500 * nm,
            object_distance=200.0,
            pixel_integration=False,
        )
        for plate in plates
    )
    kernel = (first - second).astype(dtype)[None, None]
    return CropConvolution(kernel, jnp.asarray(0.05, dtype), SENSOR.shape, FIELD, summed=1)


@functools.cache
def captured():
    """The capture with noise of 2 % of its contrast, and the unit of τ: max |Hᵀg|."""
    operator = camera_operator(jnp.asarray(BETA), jnp.asarray(DISTANCE))
    clean = operator(picture())
    noise = jax.random.normal(jax.random.key(1), clean.shape, clean.dtype)
    capture = clean + 0.02 * jnp.std(clean) * noise
    return capture, jnp.abs(operator.adjoint(capture)).max()


class Parameters(NamedTuple):
    """What the gradient is taken of."""

    beta: jax.Array
    distance: jax.Array
    log_tau: jax.Array
    capture: jax.Array


def parameters() -> Parameters:
    return Parameters(
        jnp.asarray(BETA), jnp.asarray(DISTANCE), jnp.asarray(math.log(TAU)), captured()[0]
    )


def tuned(problem, factor=0.4) -> Penalties:
    """Penalties with which this problem converges fast."""
    penalties = jax.lax.stop_gradient(splitting_of(problem).penalties)
    return jax.tree.map(lambda p: p * jnp.asarray(factor, p.dtype), penalties)


def psnr(at: Parameters, iterations=200):
    """PSNR of the minimiser, dB."""
    operator = camera_operator(at.beta, at.distance)
    problem = scenes.inverse((operator,), (at.capture,), tau=jnp.exp(at.log_tau) * captured()[1])
    result = solve_fixed_point(
        splitting_of(problem).with_penalties(tuned(problem)),
        jnp.zeros(problem.image_shape),
        iterations=iterations,
        tolerance=1e-14,
        relaxation=1.8,
        adjoint=NeumannSeries(1e-12, iterations),
    )
    return -10 * jnp.log10(jnp.mean((result.image - picture()) ** 2))


@functools.cache
def compiled():
    """The value, its gradient, and what counts how often the gradient is traced."""
    counted = count_traces(psnr)
    return jax.jit(psnr), jax.jit(jax.grad(counted)), counted


def along(name: str) -> Parameters:
    """A direction in one of the parameters, the others zero."""
    zero = jax.tree.map(jnp.zeros_like, parameters())
    one = getattr(zero, name)
    if name == "capture":
        direction = captured()[0] * jnp.asarray(np.random.default_rng(3).normal(size=one.shape))
    else:
        direction = jnp.ones_like(one)
    return zero._replace(**{name: direction})


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["log_tau", "beta", "distance", "capture"])
def test_the_gradient_of_a_psnr_by_differences(name):
    """τ, β, d and the capture, through at most 200 iterations, to one part in a thousand.

    Both sides are as exact as the minimiser and the series are, so that the problem must converge
    in 200 iterations: it does with 0.4 times the default penalties and α = 1.8, chosen by trial.
    With them the derivatives by β and by log τ are right to 1e-4 and 2e-5; τ is a twentieth of
    max |Hᵀg|, and the PSNR 25 dB.
    """
    value, gradient, _ = compiled()
    at, direction = parameters(), along(name)
    slopes = gradient(at)
    slope = sum(
        float(jnp.vdot(a, b))
        for a, b in zip(jax.tree.leaves(slopes), jax.tree.leaves(direction), strict=True)
    )
    expected = float(finite_difference(value, at, direction, 1e-4))
    assert abs(expected) > 1e-2 and 24 < float(value(at)) < 26
    assert slope == pytest.approx(expected, rel=1e-3)


@pytest.mark.thorough
def test_a_batch_of_captures_by_vmap():
    """Values and gradients are those of each capture alone."""
    problem, _ = scenes.problem(captures=1, tau=0.05)
    stack = jnp.stack([problem.captures[0], 0.7 * problem.captures[0][..., ::-1]])

    def brightness(capture):
        other = eqx.tree_at(lambda p: p.captures, problem, (capture,))
        result = solve_fixed_point(
            other, jnp.zeros(other.image_shape), iterations=60, tolerance=1e-9, relaxation=1.8
        )
        return jnp.sum(result.image**2)

    both = jax.value_and_grad(brightness)
    values, slopes = jax.vmap(both)(stack)
    for n in range(2):
        value, slope = both(stack[n])
        assert float(values[n]) == pytest.approx(float(value), rel=1e-9)
        assert relative_l2(slopes[n], slope) < 1e-7


def temporary(iterations: int, *, gradient: bool) -> int:
    """Bytes that XLA sets aside for a run, or for its gradient by τ."""
    problem, _ = scenes.problem((64, 70), (48, 50), captures=1)
    problem = scenes.single(problem)

    def total(tau, problem):
        other = eqx.tree_at(lambda p: p.tau, problem, tau)
        first = jnp.zeros(other.image_shape, jnp.float32)
        return jnp.sum(solve_fixed_point(other, first, iterations=iterations).image)

    function = jax.grad(total) if gradient else total
    lowered = jax.jit(function).lower(problem.tau, problem)
    analysis = lowered.compile(compiler_options=AS_IN_USE).memory_analysis()
    return analysis.temp_size_in_bytes


@pytest.mark.thorough
def test_memory_does_not_grow_with_the_iterations():
    """Neither that of the run nor that of its gradient, to the byte.

    A run holds 13 arrays of the window, here and for 256×264 pixels and half as many samples
    (window 384×540, float64), its gradient by τ 20: beside the vector that it solves for the four
    of the point at which it is taken. By spectrum and τ it is 22 and 24, with the cotangents of the
    spectrum. Residuals of the splits, which nobody asks for here, would take a run 10 more.
    """
    forward, backward = ([temporary(n, gradient=g) for n in (100, 400)] for g in (False, True))
    window = 120 * 120 * 4
    assert forward[0] == forward[1] and 4 * window < forward[0] < 15 * window
    assert backward[0] == backward[1] and forward[0] < backward[0] < 22 * window


def test_the_series_solves_linear_systems():
    """(J − 1) w = v for a contraction J, and its transpose, against a dense solve."""
    rng = np.random.default_rng(5)
    matrix = rng.normal(size=(9, 9))
    matrix *= 0.8 / np.linalg.norm(matrix, 2)
    right = rng.normal(size=9)
    operator = lx.MatrixLinearOperator(jnp.asarray(matrix - np.eye(9)))
    solver = NeumannSeries(1e-14, 1000, relaxation=1.0)
    for given, dense_matrix in ((operator, matrix), (operator.T, matrix.T)):
        solution = lx.linear_solve(given, jnp.asarray(right), solver, throw=False)
        expected = np.linalg.solve(dense_matrix - np.eye(9), right)
        np.testing.assert_allclose(solution.value, expected, rtol=1e-10)
    few = lx.linear_solve(
        operator, jnp.asarray(right), NeumannSeries(1e-14, 3, relaxation=1.0), throw=False
    )
    expected = -sum(np.linalg.matrix_power(matrix, n) @ right for n in range(4))
    np.testing.assert_allclose(few.value, expected, rtol=1e-12)
    assert int(few.stats["num_steps"]) == 3
    # of an averaged map over-relaxed, which is faster
    turn = np.linalg.qr(matrix)[0]
    averaged = lx.MatrixLinearOperator(jnp.asarray((0.9 * turn - np.eye(9)) / 2))
    solved_by = [
        lx.linear_solve(averaged, jnp.asarray(right), given, throw=False)
        for given in (NeumannSeries(1e-12, 1000), NeumannSeries(1e-12, 1000, relaxation=1.0))
    ]
    expected = np.linalg.solve(averaged.as_matrix(), right)
    np.testing.assert_allclose(solved_by[0].value, expected, rtol=1e-8)
    assert solved_by[0].stats["num_steps"] < solved_by[1].stats["num_steps"] < 1000
    none = lx.linear_solve(operator, jnp.zeros(9), solver, throw=False)
    np.testing.assert_array_equal(none.value, 0.0)


def zeros(problem):
    return jnp.zeros(problem.image_shape, problem.captures[0].dtype)


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
def test_the_implicit_derivative_is_that_of_differences():
    problem, truth = sparse(0.05)

    @jax.jit
    def error(tau):
        own = scenes.absolute(problem, tau)
        image = implicit_proximal_gradient(own, zeros(problem), iterations=2000, tolerance=1e-12)
        return jnp.sum((image - truth) ** 2)

    tau = jnp.asarray(0.05)
    wanted = finite_difference(error, tau, jnp.asarray(1.0), 1e-5)
    np.testing.assert_allclose(jax.grad(error)(tau), wanted, rtol=1e-4)
