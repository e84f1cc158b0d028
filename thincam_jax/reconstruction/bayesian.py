r"""Ridge and Poisson behind `reconstruct`: their weights from numbers that are about 1.

**Ridge.** With weights 1/σ² (`build`) and a white Gaussian prior of mean f̄ and variance s², the
image that `solve_ridge` finds is the mean of the posterior if ρ = 1/s²; the noise is in the weights
already. s is not known. It is taken as large as the brightness of the even image that explains the
captures best (`uniform_level`), a scene of full contrast:

.. math:: \rho = \rho_{rel} / s^2,\qquad s^2 = \mathrm{mean}\,\mathrm{level}^2

over batch and channels. It is the rule k = σ² / mean β² of Hoerl, Kennard and Baldwin (Commun.
Stat. 4, 105, 1975), with the even image for a first fit. f̄ is that image.

**Poisson.** Near its minimum half the deviance of counts y is :math:`(m - y)^2 / (2y)`: least
squares with the weights 1/y. `absolute_tau` with the mean count of a capture for its variance
therefore gives a τ that means the same to both, a step of noise alone.
"""

import functools
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax.reconstruction.build import absolute_tau
from thincam_jax.reconstruction.drive import Outcome
from thincam_jax.reconstruction.poisson import solve_poisson
from thincam_jax.reconstruction.problem import Deconvolution
from thincam_jax.reconstruction.registration import distance_ratios
from thincam_jax.reconstruction.regularised import first_image
from thincam_jax.reconstruction.ridge import solve_ridge

# Of the variation, in parts of the mean brightness. At 0.01 many counts are smoothed visibly more
# than by `admm_tv`; at 0.001 the two agree as well as their weights let them, in twice the steps.
_SMOOTHING = 0.001


def ridge_outcome(
    problem: Deconvolution,
    level: Float[Array, "*batch channel"],
    *,
    ridge,
    iterations: int,
    tolerance: float,
) -> Outcome:
    """The ridge reconstruction of a problem with weights 1/variance.

    - `level`: brightness of the even image that explains the captures.
    - `ridge`: ρ_rel, see `absolute_ridge`.
    """
    known = jnp.where(jnp.isfinite(level), level, 0)  # else the captures say what is wrong
    even = jnp.maximum(known, 0)[..., None, None, None]
    return solve_ridge(
        problem,
        ridge=absolute_ridge(ridge, known),
        mean=jnp.broadcast_to(even, problem.image_shape),
        iterations=iterations,
        tolerance=tolerance,
    )


def absolute_ridge(ridge, level: Float[Array, "..."]) -> float:
    """ρ of `solve_ridge` for weights 1/variance, from a number that is about 1.

    1 is the Bayes choice for pixels that vary independently by as much as their mean. More draws
    the image to its mean, less lets more noise into it.
    """
    relative = float(checks.positive("ridge", ridge, "parts of noise variance / image variance"))
    # In double precision of NumPy: squares of small brightnesses leave float32.
    variance = float(np.mean(np.asarray(level, dtype=np.float64) ** 2))
    return relative / (variance if variance > 0 else 1.0)


def poisson_outcome(
    problem: Deconvolution, *, tau, background, start, iterations: int, tolerance: float
) -> Outcome:
    """The most probable image of counts.

    - `problem`: with the counts as captures and any noise variance.
    - `tau`: relative, see `counts_problem`.
    """
    counts = counts_problem(problem, tau)
    return solve_poisson(
        counts,
        background=_backgrounds(background, counts),
        image=None if start is None else first_image(counts, start, even=True),
        smoothing=_SMOOTHING,
        iterations=iterations,
        tolerance=tolerance,
    )


def counts_problem(problem: Deconvolution, tau) -> Deconvolution:
    """The problem with weights of 1, or 0 where a pixel is not trusted, and τ of its counts.

    `tau`: relative to the noise of each capture's mean count, background included.
    """
    pairs = list(zip(problem.captures, problem.weights, strict=True))
    captures = [jnp.where(w > 0, c, 0) for c, w in pairs]
    weights = [(w > 0).astype(c.dtype) for c, w in pairs]
    means = [mean_count(c, w) for c, w in zip(captures, weights, strict=True)]
    return Deconvolution(
        problem.operators,
        captures,
        tau=absolute_tau(tau, problem.operators, means),
        weights=weights,
        variation=problem.variation,
    )


def mean_count(capture: Float[Array, "..."], weight: Float[Array, "..."]) -> Float[Array, ""]:
    """The mean over the trusted pixels, which is their variance; 1 if there is no count."""
    trusted = jnp.isfinite(capture) & (weight > 0)
    mean = jnp.sum(jnp.where(trusted, capture, 0)) / jnp.maximum(
        jnp.sum(trusted.astype(capture.dtype)), 1
    )
    return jnp.where(mean > 0, mean, 1)


def check_one_scale(cameras: Sequence) -> None:
    """Counts that are interpolated are counts no more."""
    if max(distance_ratios(cameras)) > 1:
        raise ValueError(
            "method 'poisson' needs all cameras at one distance, since captures that are enlarged "
            "are no counts; use 'admm_tv'"
        )


def _backgrounds(background, problem: Deconvolution) -> list[Float[Array, "..."]] | None:
    """The dark level of each capture."""
    if background is None:
        return None
    count = len(problem.captures)
    several = isinstance(background, list | tuple) or np.ndim(background) > 0
    each = list(background) if several else [background] * count
    if len(each) != count:
        raise ValueError(
            f"{len(each)} backgrounds for {count} captures; give one for each, such as [frame] for "
            "one"
        )
    check = functools.partial(_checked_background, problem.captures[0].dtype)
    return [check(b, c.shape) for b, c in zip(each, problem.captures, strict=True)]


def _checked_background(dtype, background, shape) -> Float[Array, "..."]:
    try:
        known = jnp.asarray(background, dtype)
    except (TypeError, ValueError):
        raise ValueError(f"background {background!r} is no number; give dark counts") from None
    try:
        fits = jnp.broadcast_shapes(known.shape, shape) == shape
    except ValueError:
        fits = False
    if not fits:
        raise ValueError(
            f"a background has shape {known.shape}; give one number or one for each pixel of a "
            f"capture, {shape[-2:]}"
        )
    if not bool(jnp.all((known >= 0) & jnp.isfinite(known))):
        raise ValueError("background is negative or not finite; give the mean dark counts")
    return known
