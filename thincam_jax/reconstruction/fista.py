r"""FISTA: accelerated proximal gradients with restart, for total variation or any regulariser.

.. math:: E(f) = \tfrac12 \sum_k \|\sqrt{w_k}\,(A_k f - g_k)\|^2 + \tau R(f),\qquad f \ge 0

Each iteration applies every A and Aᵀ once and the proximal map of R. Other than ADMM it has no
penalties to be found, and takes any regulariser; it needs more iterations.
"""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Float, PyTree

from thincam_jax._core.checks import Number
from thincam_jax.reconstruction.drive import Callback, OptimistixMethod, Outcome, drive
from thincam_jax.reconstruction.problem import InverseProblem, start_image, total_misfit, worth
from thincam_jax.reconstruction.regularisers import (
    AbstractRegulariser,
    Image,
    Parts,
    first_t,
    no_dual,
    prox,
    run_on,
)
from thincam_jax.reconstruction.scaled import ScaledProblem


class AbstractProximalMap(eqx.Module):
    """What follows each gradient step: x from v, with whatever it keeps from step to step."""

    @abc.abstractmethod
    def start(self, image: Image) -> Parts:
        """What is kept, of a first image."""

    @abc.abstractmethod
    def __call__(self, image: Image, kept: Parts) -> tuple[Image, Parts]:
        """x, and what to keep."""


class RegulariserMap(AbstractProximalMap):
    """The proximal map of τR, with x ≥ 0 where asked.

    - `inner`: its iterations where it has no closed form.
    """

    regulariser: AbstractRegulariser
    tau: Float[Array, ""]
    nonnegative: bool = eqx.field(static=True)
    inner: int = eqx.field(static=True, default=10)

    def start(self, image: Image):
        return no_dual(self.regulariser, image)

    def __call__(self, image: Image, kept: Parts):
        asked = {"nonnegative": self.nonnegative, "iterations": self.inner}
        return prox(self.regulariser, image, self.tau, kept, **asked)


class FistaState(eqx.Module):
    """Where an accelerated iteration stands beside its image.

    - `lead`: where the next gradient is taken.
    - `t`: the length of the run-up since the start or the last restart, of each batch element.
    - `kept`: what the proximal map keeps from step to step.
    - `primal`: length of the last step ‖x⁺ − y‖/‖x⁺‖, zero at a minimum only; `dual`: how far the
      image moved, ‖x⁺ − x‖/‖x⁺‖.
    """

    lead: Image
    t: Float[Array, "*batch 1 1 1 1"]
    kept: Parts
    primal: Float[Array, ""]
    dual: Float[Array, ""]


class AcceleratedProximalGradient(optimistix.AbstractMinimiser):
    r"""FISTA with restart for `optimistix.minimise`: f smooth, plus what `proximal` stands for.

    The function given to `minimise` is the smooth part alone; its gradient must be Lipschitz with
    1, as `ScaledProblem` makes it. It ends when both residuals of `FistaState` are below `rtol`.

    To differentiate the solution pass `adjoint=optimistix.RecursiveCheckpointAdjoint()`. The
    default `ImplicitAdjoint` takes the gradient of the smooth part to be zero, which it is not: its
    derivatives would be wrong. For implicit derivatives see `implicit_proximal_gradient`.
    """

    proximal: AbstractProximalMap
    rtol: Any
    atol: float = eqx.field(static=True)
    norm: Callable[[PyTree], Float[Array, ""]] = eqx.field(static=True)

    def __init__(self, proximal: AbstractProximalMap, rtol: Number):
        # An array, so that another tolerance is not compiled anew.
        self.proximal, self.rtol = proximal, jnp.asarray(rtol)
        self.atol, self.norm = 0.0, optimistix.two_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> FistaState:
        endless = jnp.asarray(jnp.inf, y.dtype)
        return FistaState(y, first_t(y), self.proximal.start(y), endless, endless)

    def step(self, fn, y, args, options, state, tags) -> tuple[Array, FistaState, Any]:
        (_, aux), slope = eqx.filter_value_and_grad(fn, has_aux=True)(state.lead, args)
        image, kept = self.proximal(state.lead - slope, state.kept)
        (lead,), t = run_on((y,), (state.lead,), (image,), state.t)
        primal = relative_length(image - state.lead, image)
        dual = relative_length(image - y, image)
        return image, FistaState(lead, t, kept, primal, dual), aux

    def terminate(self, fn, y, args, options, state, tags):
        worst = jnp.maximum(state.primal, state.dual)
        return worst <= self.rtol.astype(worst.dtype), optimistix.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


def relative_length(
    difference: Float[Array, "*shape"], reference: Float[Array, "*shape"]
) -> Float[Array, ""]:
    """‖difference‖/‖reference‖; zero if both are, infinite if only the reference is."""
    above, below = (jnp.sqrt(jnp.sum(x**2)) for x in (difference, reference))
    ratio = above / jnp.where(below > 0, below, 1)
    return jnp.where(below > 0, ratio, jnp.where(above > 0, jnp.inf, 0))


class AbstractScaledMethod(OptimistixMethod):
    """Steps on the misfit of a problem in units in which a gradient step of length 1 is right."""

    scaled: eqx.AbstractVar[ScaledProblem]

    @property
    def arguments(self):
        return self.scaled.problem

    @staticmethod
    def function(value: Image, arguments: InverseProblem):
        return total_misfit(value, arguments), None

    def value_of(self, image: Image):
        return image / self.scaled.image_unit

    def image_of(self, value: Image):
        return value * self.scaled.image_unit


class FistaMethod(AbstractScaledMethod):
    """FISTA for a problem.

    - `inner`: iterations of a proximal map that has no closed form.
    """

    problem: InverseProblem
    scaled: ScaledProblem
    solver: Any

    def __init__(self, problem: InverseProblem, *, inner: int = 10):
        self.problem = problem
        self.scaled = ScaledProblem(problem)
        proximal = RegulariserMap(
            problem.regulariser, self.scaled.problem.absolute_tau, problem.nonnegative, inner
        )
        self.solver = AcceleratedProximalGradient(proximal, 0.0)

    def objective(self, image: Image):
        return worth(self.problem, image)


def solve_fista(
    problem: InverseProblem,
    *,
    image: Float[Array, "..."] | None = None,
    iterations: int = 500,
    tolerance: float = 1e-5,
    inner: int = 10,
    callback: Callback | None = None,
) -> Outcome:
    """The minimiser of a problem by FISTA, with whatever regulariser the problem has.

    **Arguments**

    - `image`: to start from; default the uniform image that explains the captures best.
    - `tolerance`: relative length of a step at which to end.
    - `inner`: iterations of the proximal map where it has no closed form.
    - `callback`: see `drive`.
    """
    return drive(
        FistaMethod(problem, inner=inner),
        start_image(problem, image),
        iterations=iterations,
        tolerance=tolerance,
        callback=callback,
    )
