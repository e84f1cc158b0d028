"""Proximal gradients by jaxopt, differentiated implicitly."""

import functools

import jax
import jax.numpy as jnp

from thincam_jax.reconstruction.problem import InverseProblem, total_misfit
from thincam_jax.reconstruction.regularisers import Image, no_dual, prox
from thincam_jax.reconstruction.scaled import ScaledProblem


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

    `jaxopt.ProximalGradient` run to the end. Its derivative with respect to captures, weights, τ
    and the operators is that of the fixed point f = prox(f − ∇E(f)) (implicit differentiation):
    memory does not grow with `iterations`. It is exact where the proximal map has a closed form
    (sparsity without f ≥ 0) and the run has converged. Elsewhere the map is cut off after `inner`
    iterations, and the derivative is as good as that. For total variation see `solve_fixed_point`.

    - `image`: to start from.
    - `tolerance`: length of the last step, in units in which captures are about 1.
    """
    import jaxopt  # slow to import, and nothing else of this room needs it

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
    """jaxopt's, with the momentum's t of the image's precision instead of the default one."""
    return given(image, hyperparameters, problem)._replace(t=jnp.ones((), image.dtype))


def _prox(nonnegative: bool, inner: int, image, hyperparameters, scale=1.0):
    regulariser, tau = hyperparameters
    dual = no_dual(regulariser, image)
    return prox(regulariser, image, scale * tau, dual, nonnegative=nonnegative, iterations=inner)[0]
