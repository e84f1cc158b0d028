r"""Solvers of jaxopt for a deconvolution; the only file of this package that imports it."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxopt
from jaxtyping import Array, Float

from thincam_jax.reconstruct.drive import AbstractMethod, Residuals
from thincam_jax.reconstruct.fista import ProximalStep, relative_length
from thincam_jax.reconstruct.problem import Deconvolution, misfit
from thincam_jax.reconstruct.proximal_minimiser import total_misfit
from thincam_jax.reconstruct.regulariser import AbstractRegulariser, no_dual, prox
from thincam_jax.reconstruct.scaled import ScaledProblem


class JaxoptState(eqx.Module):
    """An image and jaxopt's own state."""

    image: Float[Array, "*batch channel plane y x"]
    inside: Any  # jaxopt.ProxGradState, which is not public


class JaxoptGradient(AbstractMethod[JaxoptState]):
    """`jaxopt.ProximalGradient`, one update an iteration.

    Its only residual is how far the image moved; it stands for both.
    """

    problem: Deconvolution
    scaled: ScaledProblem
    step: ProximalStep

    def start(self, image):
        return _start(self.scaled, self.step, image / self.scaled.image_unit)

    def advance(self, state, count):
        return _advance(self.scaled, self.step, state, count)

    def image(self, state):
        return state.image * self.scaled.image_unit

    def objective(self, image):
        return _objective(self.problem, self.step.regulariser, image)

    def look(self, state):
        after, moved = _look(self.scaled, self.step, state)
        moved = float(moved)
        return after, Residuals(moved, moved)


@functools.partial(jax.jit, static_argnames=("iterations", "tolerance", "inner"))
def implicit_minimiser(
    problem: Deconvolution,
    regulariser: AbstractRegulariser,
    image: Float[Array, "*batch channel plane y x"],
    *,
    iterations: int = 500,
    tolerance: float = 1e-8,
    inner: int = 50,
) -> Float[Array, "*batch channel plane y x"]:
    r"""The minimiser of misfit + τR as a differentiable function of the problem.

    `jaxopt.ProximalGradient` run to the end. Its derivative with respect to captures, weights, τ
    and the operators is that of the fixed point f = prox(f − ∇E(f)) (implicit differentiation):
    memory does not grow with `iterations`. It is exact where the proximal map is (sparsity without
    a sign) and the run has converged, and as good as the `inner` iterations are otherwise.

    - `image`: to start from.
    - `tolerance`: length of the last step, in units in which captures are about 1.
    """
    scaled = ScaledProblem(problem)
    solver = _solver(problem.nonnegative, inner, iterations, tolerance)
    start = jax.lax.stop_gradient(image / scaled.image_unit)
    found = solver.run(start, (regulariser, scaled.problem.tau), scaled.problem)
    return found.params * scaled.image_unit


def _solver(nonnegative: bool, inner: int, iterations: int = 1, tolerance: float = 0.0):
    solver = jaxopt.ProximalGradient(
        fun=total_misfit,
        prox=functools.partial(_prox, nonnegative, inner),
        stepsize=1.0,  # of a `ScaledProblem`
        maxiter=iterations,
        tol=tolerance,
    )
    solver.init_state = functools.partial(_init_state, solver.init_state)  # type: ignore
    return solver


def _init_state(given, image, hyperparameters, problem):
    """jaxopt's, with the momentum's t of the image's precision instead of the default one."""
    return given(image, hyperparameters, problem)._replace(t=jnp.ones((), image.dtype))


def _prox(nonnegative: bool, inner: int, image, hyperparameters, scale=1.0):
    regulariser, tau = hyperparameters
    dual = no_dual(regulariser, image)
    return prox(regulariser, image, scale * tau, dual, nonnegative=nonnegative, iterations=inner)[0]


@jax.jit
def _start(scaled: ScaledProblem, step: ProximalStep, image) -> JaxoptState:
    solver = _solver(step.nonnegative, step.inner)
    return JaxoptState(image, solver.init_state(image, None, scaled.problem))


def _update(scaled: ScaledProblem, step: ProximalStep, state: JaxoptState) -> JaxoptState:
    solver = _solver(step.nonnegative, step.inner)
    return JaxoptState(
        *solver.update(state.image, state.inside, (step.regulariser, step.tau), scaled.problem)
    )


@functools.partial(jax.jit, static_argnames="count")
def _advance(scaled, step, state, count: int):
    for _ in range(count):
        state = _update(scaled, step, state)
    return state


@jax.jit
def _look(scaled, step, state):
    after = _update(scaled, step, state)
    return after, relative_length(after.image - state.image, after.image)


@jax.jit
def _objective(problem, regulariser, image):
    return misfit(problem, image) + problem.tau * regulariser(image)
