r"""Ridge (Tikhonov) regression: the posterior mean under a white prior.

.. math:: f = \arg\min_f \tfrac12 \sum_k \|\sqrt{w_k}\,(A_k f - g_k)\|^2
    + \tfrac{\rho}{2}\|f - \bar f\|^2, \qquad
    \Big(\sum_k A_k^T w_k A_k + \rho\Big)(f - \bar f) = \sum_k A_k^T w_k (g_k - A_k \bar f)

It is linear in the captures and knows the crop of the sensor and the weight of every pixel, which a
Wiener filter does not. With weights 1/σ² and a white Gaussian prior of mean f̄ and variance s²,
f is the mean of the posterior if ρ = 1/s². s is not known. It is taken as large as the brightness
of the uniform image that explains the captures best (`uniform_level`), a scene of full contrast:

.. math:: \rho = \rho_{rel} / s^2,\qquad s^2 = \mathrm{mean}\,\mathrm{level}^2

over batch and channels. It is the rule k = σ² / mean β² of Hoerl, Kennard and Baldwin (Commun.
Stat. 4, 105, 1975), with the uniform image for a first fit. f̄ is that image.
"""

import functools
import time
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax.reconstruction.drive import Outcome, concluded
from thincam_jax.reconstruction.normal_equations import IterativeNormal, normal_equations
from thincam_jax.reconstruction.problem import (
    InverseProblem,
    back_projected,
    misfit,
    residuals,
    start_image,
    uniform_level,
)
from thincam_jax.reconstruction.scaled import ScaledProblem
from thincam_jax.reconstruction.solver import AbstractSolver, as_synthesis, check_limits


class Ridge(AbstractSolver):
    """The posterior mean under a white prior, linear in the captures; it may be negative.

    Dense and separable operators are factorised, all others take conjugate gradients.

    **Arguments**

    - `ridge`: noise variance over image variance, in parts of what the captures' mean brightness
      makes of it. 1 is right for pixels that vary independently by as much as their mean. More
      draws the image to its mean, less lets more noise into it.
    - `synthesis`: as of `AdmmTV`.
    - `iterations`: at most. `tolerance`: of the residual of the normal equations and of the last
      step, root mean square, relative to the right-hand side and the image.

    **Errors**: ValueError, one line, for values out of range.
    """

    name: ClassVar[str] = "ridge"
    ridge: float = eqx.field(static=True)
    synthesis: np.ndarray | None
    iterations: int = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)

    def __init__(
        self, ridge=1.0, *, synthesis=None, iterations: int = 300, tolerance: float = 1e-4
    ):
        self.ridge = float(checks.positive("ridge", ridge, "noise variance / image variance"))
        self.synthesis = as_synthesis(synthesis)
        check_limits(iterations, tolerance)
        self.iterations, self.tolerance = iterations, tolerance

    def solve(self, recording):
        problem = recording.problem(synthesis=self.synthesis)
        # Sums in which the uniform light cancels do not tell how bright the scene is; the captures
        # do.
        plain = problem if self.synthesis is None else recording.problem()
        level = _level(plain)
        level = jnp.where(jnp.isfinite(level), level, 0)  # else the captures say what is wrong
        mean = jnp.maximum(level, 0)[..., None, None, None]
        outcome = solve_ridge(
            problem,
            precision=self.ridge * image_precision(level),
            mean=jnp.broadcast_to(mean, problem.image_shape),
            iterations=self.iterations,
            tolerance=self.tolerance,
        )
        return recording.reconstruction(problem, outcome, self.name)


def image_precision(level: Float[Array, "..."]) -> float:
    """1/s² of a scene of full contrast and this brightness; 1 of a dark one."""
    # In double precision of NumPy: squares of small brightnesses leave float32.
    variance = float(np.mean(np.asarray(level, dtype=np.float64) ** 2))
    return 1.0 / (variance if variance > 0 else 1.0)


def solve_ridge(
    problem: InverseProblem,
    *,
    precision,
    mean: Float[Array, "..."] | None = None,
    iterations: int = 300,
    tolerance: float = 1e-6,
) -> Outcome:
    """The ridge reconstruction of a problem; its τ, R and sign are not used.

    One piece of compiled code: there is no progress to be watched.

    **Arguments**

    - `precision`: ρ > 0, 1/variance of the image, where the weights are 1/variance of the noise.
    - `mean`: f̄, what the image is drawn to; default the uniform image that explains the captures.
    - `iterations`, `tolerance`: of conjugate gradients, see `Ridge`.
    """
    began = time.perf_counter()
    dtype = problem.captures[0].dtype
    rho = checks.positive("precision", precision, "1/variance of the image").astype(dtype)
    mean = start_image(problem, mean)
    image, converged, steps = _solve(problem, rho, mean, jnp.asarray(tolerance, dtype), iterations)
    return concluded(
        mean,
        image,
        functools.partial(ridge_objective, problem, rho, mean),
        converged=bool(converged),
        iterations=int(steps),
        began=began,
    )


@jax.jit
def ridge_objective(
    problem: InverseProblem,
    precision: Float[Array, ""],
    mean: Float[Array, "*batch channel plane y x"],
    image: Float[Array, "*batch channel plane y x"],
) -> Float[Array, "*batch"]:
    """The misfit plus ρ/2 ‖f − f̄‖² of each batch element."""
    gap = jnp.sum((image - mean) ** 2, axis=(-4, -3, -2, -1))
    return misfit(problem, image) + precision / 2 * gap


@functools.partial(jax.jit, static_argnames="iterations")
def _solve(problem: InverseProblem, precision, mean, tolerance, iterations: int):
    scaled = ScaledProblem(problem)
    inside, mean = scaled.problem, mean / scaled.image_unit
    target = -back_projected(inside, residuals(inside, mean))
    normal = normal_equations(inside, precision / scaled.curvature)
    if isinstance(normal, IterativeNormal):
        solution = normal.solution(target, jnp.zeros_like(target), tolerance, iterations)
        change, steps = solution.value, solution.stats["num_steps"]
        converged = solution.result == lineax.RESULTS.successful
    else:
        change = normal.solve(target)
        converged, steps = jnp.isfinite(change).all(), jnp.asarray(1)
    return (mean + change) * scaled.image_unit, converged, steps


_level = jax.jit(uniform_level)
