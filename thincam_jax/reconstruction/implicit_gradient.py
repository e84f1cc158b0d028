r"""Minimisers as differentiable functions of a problem, by implicit differentiation.

ADMM-TV is one compiled `optimistix.fixed_point`: f* = image(q*), q* = T(q*; θ), so that by the
implicit function theorem

.. math:: \frac{dq^*}{d\theta} = (1 - J)^{-1}\,\partial_\theta T,\qquad J = \partial_q T

however q* was found. Neither iterations nor their number are stored. T is averaged, so the series
Σ Jⁿ that `NeumannSeries` sums converges as the iteration itself does. Any regulariser is minimised
by proximal gradients of jaxopt.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from thincam_jax._core.arguments import any_rank
from thincam_jax._core.checks import Number
from thincam_jax._core.module import Module
from thincam_jax.reconstruction.admm import RELAXATION, AbstractSplitting, Admm, admm_map
from thincam_jax.reconstruction.problem import (
    InverseProblem,
    detector_shape,
    forward,
    total_misfit,
    weighted_mean,
)
from thincam_jax.reconstruction.regularisers import Image, prox, zero_dual
from thincam_jax.reconstruction.scaled_problem import ScaledProblem
from thincam_jax.reconstruction.splittings import splitting_of


class FixedPoint(Module):
    """The image of a fixed point, its number of iterations, and whether it converged.

    Where `converged` is False, image and gradient are some per cent off: give more `iterations`,
    or a looser `tolerance` where the gradient with twice as many is the same.
    """

    image: Image
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]


class NeumannSeries(lx.AbstractLinearSolver):
    r"""Solves (J − 1) w = v by w ← w + α ((J − 1) w − v), J the Jacobian of an averaged map.

    It needs one vector, and converges as fast as the iteration, also if 1 − J is singular in
    directions without effect (the duals of constraints that hold exactly).

    - `tolerance`: on the change of w, relative to w, both in the root mean square.
    - `max_steps`: at most; the sum so far is then returned without a warning, and may be some ten
      per cent short if the iteration itself converges slowly. Compare another number.
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


@any_rank
def solve_fixed_point(
    problem: InverseProblem | AbstractSplitting,
    image: Image,
    *,
    iterations: int = 500,
    tolerance: float = 1e-6,
    relaxation: Number = RELAXATION,
    adjoint: lx.AbstractLinearSolver | None = None,
) -> FixedPoint:
    """The minimiser of an `InverseProblem` by ADMM-TV, for use under jit, grad and vmap.

    Differentiable in captures, PSFs (and so in β, d, λ that they were computed from), τ and
    weights. The gradient is that of the minimiser, not of the iteration: with few iterations, or a
    loose tolerance, it is as far from differences of results as these are from the minimum.
    Penalties and start image do not change the minimiser, and have no gradient. Where a background
    is sought and a uniform image casts a uniform capture, as with `Psfs` of the whole field, data
    and variation leave the brightness of the image open: its darkest pixel is then 0, in each
    channel (and each plane of its own, without a `depth_weight`).

    **Arguments**

    - `problem`: or its splitting, such as `splitting_of(problem).with_penalties(…)`.
    - `iterations`: highest number of iterations; `tolerance`: relative change of the state at which
      they end, see `Admm`.
    - `relaxation`: α of `thincam_jax.reconstruction.admm`.
    - `adjoint`: the linear solver of the gradient, default `NeumannSeries()`.

    ```python
    import jax.numpy as jnp
    import numpy as np
    import thincam_jax as tc
    from thincam_jax.reconstruction import solve_fixed_point

    psf = np.random.default_rng(0).random((9, 9))
    problem = tc.Recording(np.ones((1, 24, 32)), tc.Psfs(psf[None]), noise_variance=0.01).problem()
    found = solve_fixed_point(problem, jnp.zeros(problem.image_shape), iterations=50)
    print(found.image.shape)  # (1, 1, 32, 40)
    ```

    **See also**: `reconstruction.implicit_gradient.implicit_proximal_gradient`, `AdmmTV`.
    """
    splitting = splitting_of(problem) if isinstance(problem, InverseProblem) else problem
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
        _with_level(splitting, splitting.image(solution.value)),
        jnp.asarray(solution.stats["num_steps"]),
        solution.result == optx.RESULTS.successful,
    )


# Part of the squares of a uniform image's capture that may not be uniform.
_UNIFORM = 1e-8


def _with_level(splitting: AbstractSplitting, image: Image) -> Image:
    """The image less its darkest pixel, where only the iteration's path says how bright it is."""
    data: Any = getattr(splitting, "problem", splitting)
    if data.background == "known":
        return image
    is_open = jnp.asarray(True)
    for operator, weight in zip(data.operators, data.weights, strict=True):
        axes = len(detector_shape(operator))
        flat = jax.lax.stop_gradient(forward(operator, jnp.ones((1,) * 4, image.dtype)))
        uneven = weighted_mean(weight, (flat - weighted_mean(weight, flat, axes)) ** 2, axes)
        is_open &= (uneven <= _UNIFORM * weighted_mean(weight, flat**2, axes)).reshape(-1, 1, 1, 1)
    own = jnp.min(image, axis=(-2, -1), keepdims=True)
    joint = jnp.min(own, axis=-3, keepdims=True)
    level = jnp.where(splitting.variation.depth_weight > 0, joint, own)
    return image - jnp.where(is_open, level, 0)


def _norm(tree: PyTree[Array]) -> Float[Array, ""]:
    return jnp.sqrt(sum(jnp.sum(x**2) for x in jax.tree.leaves(tree)))


@functools.partial(jax.jit, static_argnames=("iterations", "tolerance", "inner"))
def implicit_proximal_gradient(
    problem: InverseProblem,
    image: Image,
    *,
    iterations: int = 500,
    tolerance: float = 1e-8,
    inner: int = 50,
) -> Image:
    r"""The minimiser of a problem with any regulariser, as a differentiable function of it.

    `jaxopt.ProximalGradient` until convergence. Its derivative with respect to captures, weights, τ
    and operators is that of the fixed point f = prox(f − ∇E(f)): memory does not grow with
    `iterations`. It is exact if the proximal map has a closed form (sparsity without f ≥ 0) and the
    run has converged. Otherwise the map is truncated after `inner` iterations, and the derivative
    is as accurate as that. For total variation see `solve_fixed_point`.

    - `image`: to start from.
    - `tolerance`: length of the last step, in units in which captures are about 1.

    ```python
    import jax.numpy as jnp
    import numpy as np
    import thincam_jax as tc
    from thincam_jax.reconstruction.implicit_gradient import implicit_proximal_gradient

    psf = np.random.default_rng(0).random((9, 9))
    problem = tc.Recording(np.ones((1, 24, 32)), tc.Psfs(psf[None]), noise_variance=0.01).problem()
    image = implicit_proximal_gradient(problem, jnp.zeros(problem.image_shape), iterations=20)
    ```

    **See also**: `reconstruction.solve_fixed_point`, `Fista`.
    """
    import jaxopt  # here, since it is slow to import

    scaled = ScaledProblem(problem)
    solver = jaxopt.ProximalGradient(
        fun=total_misfit,
        prox=functools.partial(_prox, problem.nonnegative, inner),
        stepsize=1.0,  # of a `ScaledProblem`
        maxiter=iterations,
        tol=tolerance,
    )
    solver.init_state = functools.partial(_init_state, solver.init_state)  # type: ignore
    start = jax.lax.stop_gradient(image / scaled.image_unit)
    weighing = (problem.regulariser, scaled.problem.absolute_tau)
    found = solver.run(start, weighing, scaled.problem)
    return found.params * scaled.image_unit


def _init_state(given, image, hyperparameters, problem):
    """jaxopt's initial state, with the momentum t in the image's precision."""
    return given(image, hyperparameters, problem)._replace(t=jnp.ones((), image.dtype))


def _prox(nonnegative: bool, inner: int, image, hyperparameters, scale=1.0):
    regulariser, tau = hyperparameters
    dual = zero_dual(regulariser, image)
    return prox(regulariser, image, scale * tau, dual, nonnegative=nonnegative, iterations=inner)[0]
