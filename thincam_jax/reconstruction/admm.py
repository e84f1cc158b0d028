r"""ADMM for total variation: its fixed-point map, for operators of any structure.

The image f is split so that each part of the objective has a proximal map in closed form. With
K f the parts, penalties μ (diagonal M) and the scaled duals λ, only q = Kf + λ is carried along, in
the Douglas–Rachford form of ADMM (Eckstein and Bertsekas, Math. Program. 55, 293, 1992),

.. math:: z = \mathrm{prox}(q),\quad f = (K^T M K)^{-1} K^T M (2z - q),\quad
    T(q) = q + K f - z .

The minimiser is a fixed point of T, which is averaged: q ← q + α (T(q) − q) converges for
0 < α < 2. α = 1 is plain ADMM, 1 < α < 2 over-relaxes. This needs half of the usual arrays, and
implicit differentiation needs such a map.

The operators determine how f is split, see `splittings.py`.
"""

import abc
import math
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Float, PyTree

from thincam_jax._core.checks import Number
from thincam_jax.reconstruction.iterate import OptimistixMethod, Residuals, SolverState
from thincam_jax.reconstruction.problem import InverseProblem, compiled_objective
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.total_variation import TotalVariation

# Default α of over-relaxation.
RELAXATION = 1.8


class Penalties(eqx.Module):
    """Penalties μ of the three splits, in the units of the splitting."""

    data: Float[Array, ""]
    variation: Float[Array, ""]
    image: Float[Array, ""]


class State(eqx.Module):
    """q of the three splits: data, differences and image."""

    data: tuple[Float[Array, "..."], ...]
    slopes: tuple[Float[Array, "..."], ...]
    image: Float[Array, "..."]


Splitting = TypeVar("Splitting", bound="AbstractSplitting")


class AbstractSplitting(eqx.Module):
    """A problem split for ADMM, in units in which captures, operators and weights are about 1.

    Iterations do not depend on the units of the captures, and the image scales with the captures.

    - `tau`: weight of the variation in these units.
    - `image_unit`: the image is that of `State`, times this.
    - `settling`: penalties adapt only while an overall residual is above this.
    """

    settling: ClassVar[float] = 0.0
    penalties: Penalties
    tau: Float[Array, ""]
    variation: TotalVariation
    image_unit: Float[Array, ""]
    nonnegative: bool = eqx.field(static=True)

    @abc.abstractmethod
    def start(self, image: Image) -> State:
        """The state of a start image, with dual variables zero."""

    @abc.abstractmethod
    def image(self, state: State) -> Image:
        """The image of a state, non-negative if constrained."""

    @abc.abstractmethod
    def reflected(self, state: State) -> State:
        """2z − q, where z minimises each part of the objective plus μ/2 ‖z − q‖²."""

    @abc.abstractmethod
    def nearest(self, target: State) -> State:
        """K f of the f whose K f is nearest to the target in the norm of the penalties."""

    @abc.abstractmethod
    def with_captures(self: Splitting, captures: tuple[Float[Array, "..."], ...]) -> Splitting:
        """This splitting, with its units, for other captures g."""

    def with_penalties(self: Splitting, penalties: Penalties) -> Splitting:
        """This splitting with other penalties."""
        return eqx.tree_at(lambda s: s.penalties, self, penalties)

    def settled(self: Splitting) -> Splitting:
        """This splitting prepared for hundreds of iterations with fixed penalties."""
        return self


def admm_map(state: State, splitting: AbstractSplitting) -> State:
    """T(q), for `optimistix.fixed_point(admm_map, …, args=splitting)`."""
    # The barrier makes XLA compute it once: it enters the sum of differences and the update below.
    mirrored = jax.lax.optimization_barrier(splitting.reflected(state))
    images = splitting.nearest(mirrored)
    return jax.tree.map(lambda q, m, k: q + (k - 0.5 * (q + m)), state, mirrored, images)


def consensus(splitting: AbstractSplitting, state: State) -> State:
    """z of a state."""
    return jax.tree.map(lambda q, r: 0.5 * (q + r), state, splitting.reflected(state))


def rescaled(splitting: AbstractSplitting, state: State, factors: Penalties) -> State:
    """The state that keeps image and forces when penalties are multiplied: q = z + λ, λ ∝ 1/μ."""
    return _rescaled(state, _consensus(splitting, state), factors)


@jax.jit
def _rescaled(state: State, settled: State, factors: Penalties) -> State:
    def scaled(part, factor):
        return jax.tree.map(lambda q, z: z + (q - z) / factor, *part)

    return State(
        scaled((state.data, settled.data), factors.data),
        scaled((state.slopes, settled.slopes), factors.variation),
        scaled((state.image, settled.image), factors.image),
    )


# Judging and adapting share this program: within theirs it takes longer to compile.
_consensus = eqx.filter_jit(consensus)


def squared_sizes(*states: State) -> Float[Array, "state 3"]:
    """Squared norms of the three splits of states; of all at once, half as much to compile."""

    def of_part(*parts):
        return jnp.sum(jnp.stack(parts) ** 2, axis=tuple(range(1, 1 + parts[0].ndim)))

    sums = jax.tree.map(of_part, *states)
    splits = (sums.data, sums.slopes, sums.image)
    return jnp.stack([sum(jax.tree.leaves(split)) for split in splits], axis=-1)


class AdmmState(eqx.Module):
    """Relative residuals of the last iteration.

    - `change`: ‖T(q) − q‖/‖q‖ in the norm of the penalties.
    - `primal`, `dual`: overall; `parts`: (primal, dual) of the three splits.
    """

    change: Float[Array, ""]
    primal: Float[Array, ""]
    dual: Float[Array, ""]
    parts: Float[Array, "3 2"]


class Admm(optimistix.AbstractFixedPointSolver):
    """q ← q + α (T(q) − q) for `admm_map` and its splitting, until T moves q little.

    `optimistix.fixed_point(admm_map, Admm(rtol=1e-6), splitting.start(image), args=splitting)`.
    `iterate` ends by the residuals in the state instead, those of Boyd et al. (Found. Trends Mach.
    Learn. 3, 1, 2011, section 3.3.1), relative, so that they do not depend on units (Wohlberg,
    arXiv:1704.06209). They take another proximal map, which the compiler drops from a loop that
    ends by the change: it holds 13 arrays of the window, not 23.

    - `rtol`: `AdmmState.change` must fall below it. `atol` and `norm` are not used.
    - `relaxation`: α, 0 < α < 2.
    - `judged`: whether steps are judged; `AdmmMethod` judges the last of several by itself, in half
      of the time to compile.
    """

    rtol: Any
    relaxation: Any
    judged: bool = eqx.field(static=True)
    atol: float = eqx.field(static=True)
    norm: Callable[[PyTree], Float[Array, ""]] = eqx.field(static=True)

    def __init__(self, rtol: Any, relaxation: Any = RELAXATION, *, judged: bool = True):
        self.judged = judged
        # Arrays, so that another value does not recompile.
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
        if self.judged:
            settled = consensus(args, y), consensus(args, after)
            state = _judged(args.penalties, (y, after), settled, relaxation)
        return after, state, aux

    def terminate(self, fn, y, args, options, state, tags):
        enough = state.change < self.rtol.astype(state.change.dtype)
        return enough, optimistix.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


@jax.jit
def _judged(penalties: Penalties, states, settled, relaxation) -> AdmmState:
    """Residuals of a step: distance of K f from z, and change of z, relative to the duals.

    - `states`: before and after it. `settled`: z of both.
    """
    (before, after), (old, new) = states, settled
    gap = jax.tree.map(lambda a, b: (a - b) / relaxation, after, before)
    image = jax.tree.map(jnp.add, old, gap)  # K f
    move, pull = (jax.tree.map(jnp.subtract, *pair) for pair in ((new, old), (after, new)))
    gaps, begun = squared_sizes(gap, before)  # alone: loops that end by the change want no others
    *sizes, moved, force = squared_sizes(image, old, move, pull)
    size = jnp.maximum(*sizes)
    weights = jnp.stack(jax.tree.leaves(penalties))

    def over(a, b):
        return jnp.sqrt(jnp.where(b > 0, a / jnp.where(b > 0, b, 1), 0))

    moving, length = weights @ gaps, weights @ begun
    return AdmmState(
        # From zero every change is large.
        jnp.where((length == 0) & (moving > 0), jnp.inf, over(moving, length)),
        over(moving, weights @ size),
        over(weights @ moved, weights @ force),
        jnp.stack([over(gaps, size), over(moved, force)], axis=1),
    )


class AdmmMethod(OptimistixMethod):
    """ADMM for a problem and its splitting; residual balancing adapts the penalties.

    - `relaxation`: α, 0 < α < 2.
    - `judged`: whether the last of several steps is judged; penalties do not adapt without.
    """

    problem: InverseProblem
    arguments: AbstractSplitting
    solver: Any
    judged: bool = eqx.field(static=True)
    donated, judging = True, False

    def __init__(
        self,
        problem: InverseProblem,
        splitting: AbstractSplitting,
        relaxation: Number = RELAXATION,
        *,
        judged: bool = True,
    ):
        self.problem, self.arguments, self.judged = problem, splitting, judged
        self.solver = Admm(0.0, relaxation, judged=False)

    def advance(self, state: SolverState, count: int):
        if not self.judged:
            return self.advance_unjudged(state, count)
        state = super().advance(state, count - 1)
        before = jax.device_put(state.value, may_alias=False)  # the last step reuses its memory
        state = super().advance(state, 1)
        settled = _consensus(self.arguments, before), _consensus(self.arguments, state.value)
        relaxation = self.solver.relaxation.astype(before.image.dtype)
        judged = _judged(self.arguments.penalties, (before, state.value), settled, relaxation)
        return SolverState(state.value, judged)

    def advance_unjudged(self, state: SolverState, count: int):
        return super().advance(state, count)

    def residuals(self, state: SolverState):
        return super().residuals(state) if self.judged else Residuals(math.nan, math.nan)

    @staticmethod
    def function(value: State, arguments: AbstractSplitting):
        return admm_map(value, arguments), None

    def value_of(self, image: Image):
        return self.arguments.start(image)

    def image_of(self, value: State):
        return self.arguments.image(value)

    def objective(self, image: Image):
        return compiled_objective(self.problem, image)

    def adapt(self, state: SolverState, residuals: Residuals):
        """Residual balancing: μ ← μ·√(primal/dual) of each split, by at most 3 at a time."""
        if max(residuals.primal, residuals.dual) < self.arguments.settling:
            return self, state
        factors = [math.sqrt(_ratio(*part)) for part in residuals.parts]
        if all(1 / _ENOUGH < f < _ENOUGH for f in factors):
            return self, state
        dtype = self.problem.captures[0].dtype
        wanted = Penalties(*(jnp.asarray(f, dtype) for f in factors))
        penalties = jax.tree.map(jnp.multiply, self.arguments.penalties, wanted)
        value = rescaled(self.arguments, state.value, wanted)
        other = self.arguments.with_penalties(penalties)
        method = eqx.tree_at(lambda m: m.arguments, self, other)
        return method, eqx.tree_at(lambda s: s.value, state, value)


_ENOUGH = 1.2


def _ratio(primal: float, dual: float) -> float:
    if not (primal > 0 and dual > 0):
        return 1.0
    return min(9.0, max(1 / 9.0, primal / dual))
