r"""Proximal gradients: FISTA for any regulariser.

.. math:: E(f) = \tfrac12 \sum_k \|\sqrt{w_k}\,(A_k f - g_k)\|^2 + \tau R(f),\qquad f \ge 0

FISTA with restart applies every A and Aᵀ once in each iteration, and the proximal map of R. Unlike
ADMM it needs no penalties, and takes any regulariser; it needs more iterations.
"""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Float, PyTree

from thincam_jax._core.checks import Number
from thincam_jax.reconstruction.iterate import (
    Callback,
    OptimistixMethod,
    Outcome,
    Schedule,
    iterate,
)
from thincam_jax.reconstruction.problem import (
    InverseProblem,
    compiled_objective,
    start_image,
    total_misfit,
)
from thincam_jax.reconstruction.regularisers import (
    AbstractRegulariser,
    Image,
    Parts,
    extrapolated,
    first_momentum,
    prox,
    zero_dual,
)
from thincam_jax.reconstruction.scaled_problem import ScaledProblem


class AbstractProximalMap(eqx.Module):
    """The proximal map after each gradient step: x from v, with a memory between steps."""

    @abc.abstractmethod
    def start(self, image: Image) -> Parts:
        """The memory of a start image."""

    @abc.abstractmethod
    def __call__(self, image: Image, kept: Parts) -> tuple[Image, Parts]:
        """x, and the new memory."""


class RegulariserMap(AbstractProximalMap):
    """The proximal map of τR, with x ≥ 0 if constrained.

    - `inner`: its iterations if it has no closed form.
    """

    regulariser: AbstractRegulariser
    tau: Float[Array, ""]
    nonnegative: bool = eqx.field(static=True)
    inner: int = eqx.field(static=True, default=10)

    def start(self, image: Image):
        return zero_dual(self.regulariser, image)

    def __call__(self, image: Image, kept: Parts):
        asked = {"nonnegative": self.nonnegative, "iterations": self.inner}
        return prox(self.regulariser, image, self.tau, kept, **asked)


class FistaState(eqx.Module):
    """State of an accelerated iteration, without its image.

    - `lead`: point of the next gradient.
    - `t`: momentum of each batch element, 1 at the start and after a restart.
    - `kept`: memory of the proximal map.
    - `primal`: length of the last step ‖x⁺ − y‖/‖x⁺‖, zero at a minimum only; `dual`: change of the
      image, ‖x⁺ − x‖/‖x⁺‖.
    """

    lead: Image
    t: Float[Array, "*batch 1 1 1 1"]
    kept: Parts
    primal: Float[Array, ""]
    dual: Float[Array, ""]


class AcceleratedProximalGradient(optimistix.AbstractMinimiser):
    r"""FISTA with restart for `optimistix.minimise`: a smooth function plus that of `proximal`.

    The function given to `minimise` is the smooth part alone; its gradient must have Lipschitz
    constant 1, as of `ScaledProblem`. It ends when both residuals of `FistaState` are below `rtol`.

    To differentiate the solution pass `adjoint=optimistix.RecursiveCheckpointAdjoint()`. The
    default `ImplicitAdjoint` assumes that the gradient of the smooth part is zero, which it is
    not: its derivatives would be wrong. For implicit derivatives see `implicit_proximal_gradient`.
    """

    proximal: AbstractProximalMap
    rtol: Any
    atol: float = eqx.field(static=True)
    norm: Callable[[PyTree], Float[Array, ""]] = eqx.field(static=True)

    def __init__(self, proximal: AbstractProximalMap, rtol: Number):
        # An array, so that another tolerance does not recompile.
        self.proximal, self.rtol = proximal, jnp.asarray(rtol)
        self.atol, self.norm = 0.0, optimistix.two_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> FistaState:
        endless = jnp.asarray(jnp.inf, y.dtype)
        return FistaState(y, first_momentum(y), self.proximal.start(y), endless, endless)

    def step(self, fn, y, args, options, state, tags) -> tuple[Array, FistaState, Any]:
        (_, aux), slope = eqx.filter_value_and_grad(fn, has_aux=True)(state.lead, args)
        image, kept = self.proximal(state.lead - slope, state.kept)
        (lead,), t = extrapolated((y,), (state.lead,), (image,), state.t)
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
    """Gradient steps on the misfit of a problem, rescaled to the Lipschitz constant 1."""

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
        return compiled_objective(self.problem, image)


def solve_fista(
    problem: InverseProblem,
    *,
    image: Float[Array, "..."] | None = None,
    iterations: int = 500,
    tolerance: float = 1e-5,
    inner: int = 10,
    callback: Callback | None = None,
) -> Outcome:
    """The minimiser of a problem by FISTA, with the regulariser of the problem.

    **Arguments**

    - `image`: to start from; default the uniform image that explains the captures best.
    - `tolerance`: relative length of a step at which to end.
    - `inner`: iterations of the proximal map if it has no closed form.
    - `callback`: see `iterate`.
    """
    return iterate(
        FistaMethod(problem, inner=inner),
        start_image(problem, image),
        Schedule(iterations, tolerance),
        callback=callback,
    )
