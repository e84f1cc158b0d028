r"""Reconstruction from few photons by least squares of residuals that are about Gaussian.

.. math:: E(f) = \tfrac12 \sum_k w_k\, r(y_k, m_k)^2 + \tfrac{\rho}{2 s^2} \|\Psi f\|^2

with either residual of a Poisson count y of mean m = Hf + b,

- Anscombe's: :math:`r = 2\sqrt{y + 3/8} - 2\sqrt{m + 3/8}`, of variance 1 to a few per cent from
  m = 2 on (Anscombe, Biometrika 35, 246, 1948);
- the deviance residual: :math:`r = \mathrm{sign}(m - y) \sqrt{2(m - y + y \log(y/m))}`, with which
  ½Σr² is −log L itself.

Levenberg and Marquardt's method takes second-order steps, each a linear problem solved
without a matrix by conjugate gradients.
"""

import time
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax
import optimistix
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax.reconstruction.drive import Outcome
from thincam_jax.reconstruction.outcome import concluded_by
from thincam_jax.reconstruction.poisson import Counts, Link, even_start, mean_counts
from thincam_jax.reconstruction.problem import Deconvolution
from thincam_jax.reconstruction.ridge import curvature_scale
from thincam_jax.reconstruction.scaled import start_image
from thincam_jax.reconstruction.tv_prox import VariationRegulariser

Residual = Literal["anscombe", "deviance"]


class Weighed(eqx.Module):
    """Counts, ρ and the kind of residual, as `photon_residuals` takes them."""

    counts: Counts
    smoothness: Float[Array, ""]
    residual: Residual = eqx.field(static=True)


def solve_poisson_newton(
    problem: Deconvolution,
    *,
    smoothness,
    background=None,
    residual: Residual = "anscombe",
    image: Float[Array, "..."] | None = None,
    link: Link = "square",
    iterations: int = 50,
    tolerance: float = 1e-4,
    inner: int = 20,
) -> Outcome:
    """The image of counts, by Levenberg–Marquardt (optimistix), always non-negative.

    One piece of compiled code: there is no progress to be watched.

    **Arguments**

    - `problem`, `background`, `image`, `link`: as for `solve_poisson`; τ and TV are not used.
      With the square, dark pixels reach zero in a few steps; the other links never get there.
    - `smoothness`: ρ, the weight of squared differences in parts of the mean brightness s.
    - `residual`: "anscombe" or "deviance".
    - `iterations`: steps tried, also those that are rejected.
    - `tolerance`: relative change of residuals and θ at which to end.
    - `inner`: steps of conjugate gradients in each.
    """
    began = time.perf_counter()
    checks.choice("residual", residual, ("anscombe", "deviance"))
    counts = Counts(problem, background=background, link=link)
    dtype = problem.captures[0].dtype
    smoothness = checks.non_negative("smoothness", smoothness, "parts of the mean").astype(dtype)
    weighed = Weighed(counts, smoothness, residual)
    start = even_start(counts) if image is None else start_image(problem, image)
    limit = jnp.asarray(tolerance, float)
    # No tolerance: a step that is cut short is a good step still, and no failure.
    inside = lineax.CG(rtol=0.0, atol=0.0, max_steps=inner)
    solution = optimistix.least_squares(
        scaled_residuals,
        optimistix.LevenbergMarquardt(
            rtol=limit,  # type: ignore[arg-type]
            atol=limit,  # type: ignore[arg-type]
            norm=optimistix.rms_norm,
            linear_solver=lineax.Normal(inside),
        ),
        counts.theta(start),
        args=weighed,
        max_steps=iterations,
        throw=False,
    )
    return concluded_by(
        solution,
        start,
        counts.image(solution.value),
        eqx.Partial(newton_objective, weighed),
        began=began,
    )


def photon_residuals(weighed: Weighed, image: Float[Array, "*batch channel plane y x"]):
    """What is squared and summed: the residuals of the captures, and those of smoothness."""
    counts, problem = weighed.counts, weighed.counts.problem
    of = anscombe if weighed.residual == "anscombe" else deviance_residual
    data = tuple(
        jnp.sqrt(w) * of(y, m)
        for w, y, m in zip(
            problem.weights, problem.captures, mean_counts(counts, image), strict=True
        )
    )
    slopes = VariationRegulariser(problem.variation).analyse(image / counts.unit)
    root = _root(weighed.smoothness)
    return data, tuple(root * s for s in slopes)


def scaled_residuals(theta: Float[Array, "..."], weighed: Weighed):
    """The residuals of f(θ), times a factor that keeps the conjugate gradients going."""
    factor = jnp.sqrt(curvature_scale(theta))
    found = photon_residuals(weighed, weighed.counts.image(theta))
    return jax.tree.map(lambda r: factor * r.astype(theta.dtype), found)


@jax.jit
def newton_objective(
    weighed: Weighed, image: Float[Array, "*batch channel plane y x"]
) -> Float[Array, "*batch"]:
    """E of each member of the batch."""
    data, slopes = photon_residuals(weighed, image)
    parts = [jnp.sum(r**2, axis=(-3, -2, -1)) for r in data]
    parts += [jnp.sum(r**2, axis=(-4, -3, -2, -1)) for r in slopes]
    return sum(parts[1:], start=parts[0]) / 2


def anscombe(counts: Float[Array, "..."], mean: Float[Array, "..."]) -> Float[Array, "..."]:
    """2√(m + 3/8) − 2√(y + 3/8), without cancellation."""
    above, below = jnp.sqrt(mean + 0.375), jnp.sqrt(counts + 0.375)
    return 2 * (mean - counts) / (above + below)


def deviance_residual(
    counts: Float[Array, "..."], mean: Float[Array, "..."]
) -> Float[Array, "..."]:
    """sign(m − y) √(2(m − y + y log(y/m))), smooth at m = y."""
    seen = counts > 0
    safe = jnp.where(seen, counts, 1)
    excess = jnp.where(seen, (mean - counts) / safe, 0)
    near = jnp.abs(excess) < 1e-2
    far = jnp.where(near, 1, excess)
    ratio = jnp.sqrt(2 * (far - jnp.log1p(far))) / jnp.abs(far)
    # √(2(x − log(1 + x)))/|x|, to x³: within 2e-8 below 1e-2, and its slope too.
    series = 1 - excess / 3 + 7 * excess**2 / 36 - 73 * excess**3 / 540
    root = jnp.sqrt(safe) * excess * jnp.where(near, series, ratio)
    return jnp.where(seen, root, jnp.sqrt(2 * jnp.where(seen, 1, mean)))


def _root(value):
    """√value with a derivative of zero at zero."""
    return jnp.where(value > 0, jnp.sqrt(jnp.where(value > 0, value, 1)), 0)
