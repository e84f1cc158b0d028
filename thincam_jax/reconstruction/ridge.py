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
import operator
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number
from thincam_jax.imaging.operators import Separable
from thincam_jax.reconstruction.drive import Outcome, concluded
from thincam_jax.reconstruction.normal_equations import (
    IterativeNormal,
    SeparableNormal,
    normal_equations,
)
from thincam_jax.reconstruction.problem import (
    InverseProblem,
    back_projected,
    misfit,
    residuals,
    start_image,
    uniform_level,
)
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.scaled import ScaledProblem
from thincam_jax.reconstruction.separable import RULES, Prior, Rule, choose_precision
from thincam_jax.reconstruction.solver import (
    AbstractSolver,
    Synthesis,
    as_synthesis,
    at_most,
    small_enough,
)


class Ridge(AbstractSolver):
    """The posterior mean under a white prior, linear in the captures; it may be negative.

    Dense and separable operators are factorised, all others take conjugate gradients. `deviation`
    gives the error bars of its pixels.

    **Arguments**

    - `ridge`: noise variance over image variance, in parts of what the captures' mean brightness
      makes of it. 1 is right for pixels that vary independently by as much as their mean. More
      draws the image to its mean, less lets more noise into it. "gcv" (generalised
      cross-validation) and "sure" (Stein's unbiased estimate of the risk, with the noise variance
      of the recording) find it from the captures of a separable camera of one term.
    - `synthesis`: as of `AdmmTV`.
    - `iterations`: at most. `tolerance`: of the residual of the normal equations and of the last
      step, root mean square, relative to the right-hand side and the image.

    **Errors**: ValueError, one line, for values out of range.
    """

    name: ClassVar[str] = "ridge"
    ridge: float | Rule = eqx.field(static=True)
    correlation: tuple[float, ...] = eqx.field(static=True)
    synthesis: np.ndarray | None
    iterations: int = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)

    def __init__(
        self,
        ridge: Number | str = 1.0,
        *,
        correlation: Number | Sequence[float | int] = 0.0,
        synthesis: Synthesis | None = None,
        iterations: int = 300,
        tolerance: float = 1e-4,
    ):
        if isinstance(ridge, str):
            self.ridge = cast(Rule, checks.choice("ridge", ridge, RULES))
        else:
            self.ridge = float(checks.positive("ridge", ridge, "noise variance / image variance"))
        lengths = correlation if isinstance(correlation, tuple | list) else (correlation,)
        self.correlation = tuple(
            float(checks.non_negative("correlation", one, "pixels")) for one in lengths
        )
        if not self.correlation or (len(lengths) > 1 and not isinstance(self.ridge, str)):
            raise ValueError(
                f"correlation = {correlation} and ridge = {self.ridge}: give one length, or "
                'several and ridge="sure" or "gcv", which choose among them'
            )
        self.synthesis = as_synthesis(synthesis)
        self.iterations, self.tolerance = at_most(iterations), small_enough(tolerance)

    def solve(self, recording: Recording):
        problem, white, mean, prior, precision = self._posed(recording)
        outcome = solve_ridge(
            white,
            precision=precision,
            mean=mean if prior is None else jnp.zeros_like(mean),
            iterations=self.iterations,
            tolerance=self.tolerance,
        )
        if prior is not None:
            outcome = replace(outcome, image=mean + prior.image(outcome.image))
        return recording.reconstruction(problem, outcome, self.name)

    def deviation(self, recording: Recording) -> Float[Array, "*plane y x"]:
        r"""The posterior standard deviation of each pixel, in the scene's unit.

        .. math:: \sigma_i = \Big(\sum_k A_k^T w_k A_k + \rho\Big)^{-1/2}_{ii}

        the same for every capture of this noise. Of all pixels, not of each, 95 % lie within
        1.96 σ of the truth where the noise variance is right and the image varies as the prior
        says: choose `ridge` by a rule, and `correlation` for an image that is not white, whose
        errors a white prior takes for larger than they are. What the camera hardly sees has the
        deviation of the prior, ρ^(−1/2).

        **Errors**: ValueError for operators without a closed form: convolutions, several terms.
        """
        _, white, _, prior, precision = self._posed(recording)
        scaled = ScaledProblem(white)
        normal = normal_equations(scaled.problem, precision / scaled.curvature)
        if prior is not None and isinstance(normal, SeparableNormal):
            normal = SeparableNormal(normal.problem, normal.shift, prior.modes(normal.modes))
        return jnp.sqrt(normal.variance() / scaled.curvature)

    def _posed(self, recording):
        """The problem, the one of what is white in its image, the mean, the prior, and ρ."""
        problem = recording.problem(synthesis=self.synthesis)
        # Sums in which the uniform light cancels do not tell how bright the scene is; the captures
        # do.
        plain = problem if self.synthesis is None else recording.problem()
        level = _level(plain)
        level = jnp.where(jnp.isfinite(level), level, 0)  # else the captures say what is wrong
        mean = jnp.maximum(level, 0)[..., None, None, None]
        mean = jnp.broadcast_to(mean, problem.image_shape)
        given = 1.0 if isinstance(self.ridge, str) else self.ridge * image_precision(level)
        tried = []
        for correlation in self.correlation:
            prior = _prior(problem, correlation)
            white = problem if prior is None else _whitened(problem, mean, prior)
            precision, value = given, 0.0
            if isinstance(self.ridge, str):
                start = mean if prior is None else jnp.zeros_like(mean)
                precision, value = choose_precision(white, start, self.ridge)
            tried.append((float(value), (problem, white, mean, prior, precision)))
        return min(tried, key=operator.itemgetter(0))[1]


def _prior(problem: InverseProblem, correlation: float) -> Prior | None:
    """None for a white one, which every operator takes."""
    if correlation == 0:
        return None
    first = problem.operators[0]
    if len(problem.operators) > 1 or not isinstance(first, Separable):
        raise ValueError(
            f"correlation = {correlation:g} needs one separable camera; leave it out for a "
            f"{type(first).__name__}"
        )
    return Prior.of(first.in_shape, correlation, problem.captures[0].dtype)


def _whitened(problem: InverseProblem, mean, prior: Prior) -> InverseProblem:
    """The problem of z, f = f̄ + L z."""
    (camera,), captures = problem.operators, [-r for r in residuals(problem, mean)]
    assert isinstance(camera, Separable)
    return eqx.tree_at(
        lambda p: (p.operators, p.captures), problem, ((prior.seen_by(camera),), tuple(captures))
    )


def image_precision(level: Float[Array, "..."]) -> float:
    """1/s² of a scene of full contrast and this brightness; 1 of a dark one."""
    # In double precision of NumPy: squares of small brightnesses leave float32.
    variance = float(np.mean(np.asarray(level, dtype=np.float64) ** 2))
    return 1.0 / (variance if variance > 0 else 1.0)


def solve_ridge(
    problem: InverseProblem,
    *,
    precision: Number,
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
    problem: InverseProblem, precision: Float[Array, ""], mean: Image, image: Image
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
