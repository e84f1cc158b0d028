"""ADMM-TV as a fixed-point solver of optimistix, and as a method that `drive` steps."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Float, PyTree

from thincam_jax._core.checks import Number
from thincam_jax.reconstruction.direct_splitting import DirectSplitting
from thincam_jax.reconstruction.drive import OptimistixMethod, Residuals, Running
from thincam_jax.reconstruction.fourier_splitting import FourierSplitting
from thincam_jax.reconstruction.problem import InverseProblem, convolutions, worth
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.splitting import (
    AbstractSplitting,
    Penalties,
    State,
    admm_map,
    consensus,
    rescaled,
    squared_sizes,
)
from thincam_jax.reconstruction.total_variation import TotalVariation

# α of over-relaxation where nothing else is said.
RELAXATION = 1.8


class AdmmState(eqx.Module):
    """What is known of the last iteration, all of it relative.

    - `change`: ‖T(q) − q‖/‖q‖ in the norm of the penalties.
    - `primal`, `dual`: residuals overall; `parts`: (primal, dual) of the three splits.
    """

    change: Float[Array, ""]
    primal: Float[Array, ""]
    dual: Float[Array, ""]
    parts: Float[Array, "3 2"]


class Admm(optimistix.AbstractFixedPointSolver):
    """q ← q + α (T(q) − q) for `admm_map` and its splitting, until T moves q little.

    `optimistix.fixed_point(admm_map, Admm(rtol=1e-6), splitting.start(image), args=splitting)`.
    `drive` ends by the residuals in the state instead, those of Boyd et al. (Found. Trends Mach.
    Learn. 3, 1, 2011, section 3.3.1), each relative to what it is a residual of, so that they do
    not depend on units (Wohlberg, arXiv:1704.06209). They take another proximal map, which the
    compiler drops from a loop that ends by the change: it holds 13 arrays of the window, not 23.

    - `rtol`: `AdmmState.change` must fall below it. `atol` and `norm` are not used.
    - `relaxation`: α, 0 < α < 2.
    """

    rtol: Any
    relaxation: Any
    atol: float = eqx.field(static=True)
    norm: Callable[[PyTree], Float[Array, ""]] = eqx.field(static=True)

    def __init__(self, rtol: Any, relaxation: Any = RELAXATION):
        # Arrays, so that another value is not compiled anew.
        self.rtol, self.relaxation = jnp.asarray(rtol), jnp.asarray(relaxation)
        self.atol, self.norm = 0.0, optimistix.rms_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> AdmmState:
        dtype = y.image.dtype
        endless = jnp.asarray(jnp.inf, dtype)
        return AdmmState(endless, endless, endless, jnp.full((3, 2), jnp.inf, dtype))

    def step(self, fn, y, args, options, state, tags) -> tuple[State, AdmmState, Any]:
        mapped, aux = fn(y, args)
        relaxation = self.relaxation.astype(y.image.dtype)
        after = jax.tree.map(lambda q, t: q + relaxation * (t - q), y, mapped)
        return after, _judged(args, y, after, relaxation), aux

    def terminate(self, fn, y, args, options, state, tags):
        enough = state.change < self.rtol.astype(state.change.dtype)
        return enough, optimistix.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


def _judged(splitting: AbstractSplitting, before: State, after: State, relaxation):
    """Of a step: how far K f is from z, and how far z has moved, relative to the forces."""
    old, new = consensus(splitting, before), consensus(splitting, after)
    gap = jax.tree.map(lambda a, b: (a - b) / relaxation, after, before)
    image = jax.tree.map(jnp.add, old, gap)  # K f
    size = jnp.maximum(squared_sizes(image), squared_sizes(old))
    moved = squared_sizes(jax.tree.map(jnp.subtract, new, old))
    force = squared_sizes(jax.tree.map(jnp.subtract, after, new))
    gaps = squared_sizes(gap)
    weights = jnp.stack(jax.tree.leaves(splitting.penalties))

    def over(a, b):
        return jnp.sqrt(jnp.where(b > 0, a / jnp.where(b > 0, b, 1), 0))

    moving, length = weights @ gaps, weights @ squared_sizes(before)
    return AdmmState(
        # Away from zero every change is large.
        jnp.where((length == 0) & (moving > 0), jnp.inf, over(moving, length)),
        over(moving, weights @ size),
        over(weights @ moved, weights @ force),
        jnp.stack([over(gaps, size), over(moved, force)], axis=1),
    )


def splitting_of(problem: InverseProblem) -> AbstractSplitting:
    """The splitting that suits the operators of a problem."""
    variation = problem.regulariser
    if not isinstance(variation, TotalVariation):
        raise ValueError(
            f"ADMM is for total variation; the regulariser is a {type(variation).__name__}: use "
            "Fista"
        )
    operators = convolutions(problem)
    if operators is None:
        return DirectSplitting(problem, variation)
    return FourierSplitting(problem, operators, variation)


class AdmmMethod(OptimistixMethod):
    """ADMM for a problem, its penalties balanced by the residuals.

    - `penalties`: to start with; default those of the splitting.
    - `relaxation`: α, 0 < α < 2.
    """

    problem: InverseProblem
    arguments: AbstractSplitting
    solver: Any
    donated = True

    def __init__(
        self,
        problem: InverseProblem,
        *,
        penalties: Penalties | None = None,
        relaxation: Number = RELAXATION,
    ):
        self.problem = problem
        splitting = splitting_of(problem)
        self.arguments = splitting if penalties is None else splitting.with_penalties(penalties)
        self.solver = Admm(0.0, relaxation)

    @staticmethod
    def function(value: State, arguments: AbstractSplitting):
        return admm_map(value, arguments), None

    def value_of(self, image: Image):
        return self.arguments.start(image)

    def image_of(self, value: State):
        return self.arguments.image(value)

    def objective(self, image: Image):
        return worth(self.problem, image)

    def adapt(self, state: Running, residuals: Residuals):
        """Residual balancing: μ ← μ·√(primal/dual) of each split, by at most 3 at a time."""
        if max(residuals.primal, residuals.dual) < self.arguments.settling:
            return self, state
        factors = [math.sqrt(_ratio(*part)) for part in residuals.parts]
        if all(1 / _ENOUGH < f < _ENOUGH for f in factors):
            return self, state
        dtype = self.problem.captures[0].dtype
        wanted = Penalties(*(jnp.asarray(f, dtype) for f in factors))
        penalties = jax.tree.map(jnp.multiply, self.arguments.penalties, wanted)
        value = _rescaled(self.arguments, state.value, wanted)
        other = self.arguments.with_penalties(penalties)
        method = eqx.tree_at(lambda m: m.arguments, self, other)
        return method, eqx.tree_at(lambda s: s.value, state, value)


_ENOUGH = 1.2


def _ratio(primal: float, dual: float) -> float:
    if not (primal > 0 and dual > 0):
        return 1.0
    return min(9.0, max(1 / 9.0, primal / dual))


_rescaled = eqx.filter_jit(rescaled)
