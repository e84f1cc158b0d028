r"""ADMM-TV as one differentiable function: a fixed point, and its implicit gradient.

`drive` runs an iteration from outside and cannot be differentiated. Here it is one compiled
`optimistix.fixed_point`: f* = image(q*), q* = T(q*; θ), so that by the implicit function theorem

.. math:: \frac{dq^*}{d\theta} = (1 - J)^{-1}\,\partial_\theta T,\qquad J = \partial_q T

whatever way q* was found. Neither iterations nor their number are stored. T is averaged, so the
series Σ Jⁿ that `NeumannSeries` sums converges as the iteration itself does.
"""

from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from thincam_jax._core.checks import Number
from thincam_jax._core.module import Module
from thincam_jax.reconstruction.admm import RELAXATION, Admm, splitting_of
from thincam_jax.reconstruction.problem import InverseProblem
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.splitting import Penalties, admm_map


class FixedPoint(Module):
    """An image, and whether it is one: iterations done, converged before they ran out."""

    image: Image
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]


class NeumannSeries(lx.AbstractLinearSolver):
    r"""Solves (J − 1) w = v by w ← w + α ((J − 1) w − v), J the Jacobian of an averaged map.

    It is to an averaged map what conjugate gradients are to a symmetric one: it needs one vector,
    and converges also where 1 − J is singular in directions on which nothing depends (the forces of
    constraints that hold exactly), if only as fast as the iteration.

    - `tolerance`: on the change of w, relative to w, both in the root mean square.
    - `max_steps`: when to give up; the sum so far is returned, without a sign of it, and may be
      some ten per cent short where the iteration itself converges slowly. Compare another number.
    - `relaxation`: α, 0 < α < 2 as for the iteration; 1 is the plain series, for any contraction.
    """

    tolerance: float = 1e-6
    max_steps: int = 5000
    relaxation: float = RELAXATION

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]):
        return lx.linearise(operator)

    def compute(
        self, state: lx.AbstractLinearOperator, vector: PyTree[Array], options: dict[str, Any]
    ):
        def unfinished(carry):
            _, change, count = carry
            return (change > self.tolerance) & (count < self.max_steps)

        def body(carry):
            w, _, count = carry
            step = jax.tree.map(lambda a, v: self.relaxation * (a - v), state.mv(w), vector)
            w = jax.tree.map(jnp.add, w, step)
            size = _norm(w)
            change = jnp.where(size > 0, _norm(step) / jnp.where(size > 0, size, 1), 0)
            return w, change, count + 1

        first = jax.tree.map(lambda v: -self.relaxation * v, vector)
        begin = (first, jnp.full_like(_norm(first), jnp.inf), 0)
        solution, _, count = jax.lax.while_loop(unfinished, body, begin)
        return solution, lx.RESULTS.successful, {"num_steps": count, "max_steps": self.max_steps}

    def transpose(self, state: lx.AbstractLinearOperator, options: dict[str, Any]):
        return state.transpose(), options

    def conj(self, state: lx.AbstractLinearOperator, options: dict[str, Any]):
        return lx.conj(state), options

    def assume_full_rank(self) -> bool:
        return True


def solve_fixed_point(
    problem: InverseProblem,
    image: Image,
    *,
    iterations: int = 500,
    tolerance: float = 1e-6,
    relaxation: Number = RELAXATION,
    penalties: Penalties | None = None,
    adjoint: lx.AbstractLinearSolver | None = None,
) -> FixedPoint:
    """The minimiser of a `InverseProblem` from a first image, for use under jit, grad and vmap.

    Differentiable in captures, PSFs (and so in what they were computed from: β, d, λ), τ and
    weights. The gradient is that of the minimiser, not of the iteration: with few iterations, or a
    loose tolerance, it is as far from differences of results as these are from the minimum. The
    penalties and the first image move the minimiser nowhere, and have no gradient.

    **Arguments**

    - `iterations`: at most; `tolerance`: on the relative change of the state, see `Admm`.
    - `relaxation`: α of `thincam_jax.reconstruction.splitting`.
    - `adjoint`: the linear solver of the gradient, default `NeumannSeries()`.
    """
    splitting = splitting_of(problem)
    if penalties is not None:
        splitting = splitting.with_penalties(penalties)
    solution = optx.fixed_point(
        admm_map,
        Admm(tolerance, relaxation),
        jax.lax.stop_gradient(splitting.start(image)),
        args=splitting,
        max_steps=iterations,
        adjoint=optx.ImplicitAdjoint(adjoint or NeumannSeries()),
        throw=False,
    )
    return FixedPoint(
        splitting.image(solution.value),
        jnp.asarray(solution.stats["num_steps"]),
        solution.result == optx.RESULTS.successful,
    )


def _norm(tree: PyTree[Array]) -> Float[Array, ""]:
    return jnp.sqrt(sum(jnp.sum(x**2) for x in jax.tree.leaves(tree)))
