r"""Proximal gradient methods: for total variation, or sparsity in a basis, with or without a sign.

.. math:: E(f) = \tfrac12 \sum_k \|\sqrt{w_k}\,(H_k f - g_k)\|^2 + \tau R(f),\qquad f \ge 0

Each iteration applies every H and Hᵀ once and the proximal map of R. Other than ADMM it has no
penalties to be found, and takes any regulariser; it needs more iterations.
"""

import functools
import time
from typing import Literal

import jax
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax.reconstruction import _jaxopt
from thincam_jax.reconstruction.drive import AbstractMethod, Callback, Outcome, Residuals, drive
from thincam_jax.reconstruction.fista import Course, ProximalStep, relative_length
from thincam_jax.reconstruction.outcome import concluded_by
from thincam_jax.reconstruction.problem import Deconvolution, misfit
from thincam_jax.reconstruction.proximal_minimiser import AcceleratedProximal, total_misfit
from thincam_jax.reconstruction.regulariser import AbstractRegulariser
from thincam_jax.reconstruction.scaled import ScaledProblem, gradient, scaled_problem, start_image
from thincam_jax.reconstruction.tv_prox import VariationRegulariser

Backend = Literal["own", "jaxopt", "optimistix"]


class ProximalGradient(AbstractMethod[Course]):
    """FISTA for a `Deconvolution`, its TV replaced by any regulariser.

    - `regulariser`: R; default the problem's total variation.
    - `inner`: iterations of a proximal map that has no closed form.
    - `accelerate`, `restart`: see `fista.ProximalStep`.

    Of `look`, the primal residual is the length of the last step, ‖x⁺ − y‖/‖x⁺‖, zero at a
    minimum only; the dual one is how far the image moved, ‖x⁺ − x‖/‖x⁺‖.
    """

    problem: Deconvolution
    scaled: ScaledProblem
    step: ProximalStep

    def __init__(
        self,
        problem: Deconvolution,
        *,
        regulariser: AbstractRegulariser | None = None,
        inner: int = 10,
        accelerate: bool = True,
        restart: bool = True,
    ):
        self.problem = problem
        self.scaled = scaled_problem(problem)
        self.step = ProximalStep(
            regulariser=regulariser_of(problem, regulariser),
            tau=self.scaled.problem.tau,
            length=jnp.ones((), problem.captures[0].dtype),
            nonnegative=problem.nonnegative,
            inner=inner,
            accelerate=accelerate,
            restart=restart,
        )

    def start(self, image):
        return _start(self.step, image / self.scaled.image_unit)

    def advance(self, state, count):
        return _advance(self.scaled, self.step, state, count)

    def image(self, state):
        return state.image * self.scaled.image_unit

    def objective(self, image):
        return composite(self.problem, self.step.regulariser, image)

    def look(self, state):
        state, *numbers = _look(self.scaled, self.step, state)
        primal, dual = jax.device_get(numbers)
        return state, Residuals(float(primal), float(dual))


def solve_proximal(
    problem: Deconvolution,
    *,
    regulariser: AbstractRegulariser | None = None,
    image: Float[Array, "..."] | None = None,
    iterations: int = 500,
    tolerance: float = 1e-5,
    inner: int = 10,
    backend: Backend = "own",
    look_every: int = 10,
    callback: Callback | None = None,
) -> Outcome:
    """The image that minimises misfit + τR, by accelerated proximal gradients with restart.

    **Arguments**

    - `regulariser`: R, `VariationRegulariser` (default: the problem's TV) or `Sparsity`. τ is the
      problem's.
    - `image`: to start from; default the even image that explains the captures best.
    - `tolerance`: relative length of a step at which to end.
    - `inner`: iterations of the proximal map where it has no closed form.
    - `backend`: "own"; "optimistix", the same steps in one compiled loop of
      `optimistix.minimise`, which nobody can look into; or "jaxopt", `jaxopt.ProximalGradient`:
      FISTA without restart, and with a proximal map that starts anew each time, so that it wants
      100 and more `inner` iterations.
    - `look_every`, `callback`: see `drive`; not with "optimistix".
    """
    checks.choice("backend", backend, ("own", "jaxopt", "optimistix"))
    start = start_image(problem, image)
    method: AbstractMethod = ProximalGradient(problem, regulariser=regulariser, inner=inner)
    if backend == "optimistix":
        if callback is not None:
            raise ValueError('backend "optimistix" calls no callback; use "own" or "jaxopt"')
        return _in_one_run(method, start, iterations, tolerance)
    if backend == "jaxopt":
        method = _jaxopt.JaxoptGradient(problem, method.scaled, method.step)
    return drive(
        method,
        start,
        iterations=iterations,
        tolerance=tolerance,
        look_every=look_every,
        callback=callback,
    )


def _in_one_run(method: ProximalGradient, start, iterations: int, tolerance: float) -> Outcome:
    """By `optimistix.minimise`."""
    began = time.perf_counter()
    limit = jnp.asarray(tolerance, start.dtype)
    solver = AcceleratedProximal(method.step, rtol=limit, atol=jnp.zeros_like(limit))
    solution = optimistix.minimise(
        total_misfit,
        solver,
        start / method.scaled.image_unit,
        args=method.scaled.problem,
        max_steps=iterations,
        throw=False,
        adjoint=optimistix.RecursiveCheckpointAdjoint(),
    )
    return concluded_by(
        solution,
        start,
        solution.value * method.scaled.image_unit,
        method.objective,
        began=began,
    )


def regulariser_of(
    problem: Deconvolution, regulariser: AbstractRegulariser | None
) -> AbstractRegulariser:
    """The one given, or the problem's total variation."""
    return VariationRegulariser(problem.variation) if regulariser is None else regulariser


@jax.jit
def composite(
    problem: Deconvolution,
    regulariser: AbstractRegulariser,
    image: Float[Array, "*batch channel plane y x"],
) -> Float[Array, "*batch"]:
    """The misfit plus τR of each member of the batch."""
    return misfit(problem, image) + problem.tau * regulariser(image)


def forward_backward(scaled: ScaledProblem, step: ProximalStep, course: Course) -> Course:
    return step(course, gradient(scaled.problem, course.lead))


@jax.jit
def _start(step: ProximalStep, image) -> Course:
    return step.start(image)


@functools.partial(jax.jit, static_argnames="count")
def _advance(scaled, step, course, count: int):
    for _ in range(count):
        course = forward_backward(scaled, step, course)
    return course


@jax.jit
def _look(scaled, step, course):
    after = forward_backward(scaled, step, course)
    primal = relative_length(after.image - course.lead, after.image)
    return after, primal, relative_length(after.image - course.image, after.image)
