r"""Ridge (Tikhonov) regression: the posterior mean under a white prior.

.. math:: f = \arg\min_f \tfrac12 \sum_k \|\sqrt{w_k}\,(A_k f - g_k)\|^2
    + \tfrac{\rho}{2}\|f - \bar f\|^2, \qquad
    \Big(\sum_k A_k^T w_k A_k + \rho\Big)(f - \bar f) = \sum_k A_k^T w_k (g_k - A_k \bar f)

It is linear in the captures and models the crop of the sensor and the weight of every pixel, which
a Wiener filter does not. With weights 1/σ² and a white Gaussian prior of mean f̄ and variance s²,
f is the posterior mean if ρ = 1/s². s is unknown and taken as the brightness of the uniform image
that explains the captures best (`scene_level`), as in a scene of full contrast:

.. math:: \rho = \rho_{rel} / s^2,\qquad s^2 = \mathrm{mean}\,\mathrm{level}^2

over batch and channels. It is the rule k = σ² / mean β² of Hoerl, Kennard and Baldwin (Commun.
Stat. 4, 105, 1975), with the uniform image for a first fit. f̄ is that image.

With the singular value decompositions :math:`P = U_P S V^T, Q = U_Q T W^T` of a separable camera
(FlatCam) of one term, a white prior of variance 1/ρ and noise of variance 1, the modes decouple:

.. math:: \hat g = U_P^T (g - A\bar f)\, U_Q,\qquad
    f = \bar f + V \Big[\frac{s_i t_j}{s_i^2 t_j^2 + \rho}\,\hat g_{ij}\Big] W^T

(Asif et al., IEEE Trans. Comput. Imaging 3, 384, 2017). So do the rules that choose ρ: generalised
cross-validation (Golub, Heath and Wahba, Technometrics 21, 215, 1979), which needs no variance of
the noise, and Stein's unbiased estimate of the risk (Ann. Stat. 9, 1135, 1981), which does:

.. math:: \mathrm{GCV} = \frac{N\,r(\rho)}{(N - n(\rho))^2},\qquad
    \mathrm{SURE} = r(\rho) - N + 2\,n(\rho)

with the squared residual r, N pixels of the captures and
:math:`n = \sum s^2t^2/(s^2t^2 + \rho)` degrees of freedom.
"""

import functools
import math
import operator
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, is_traced
from thincam_jax._core.precision import product
from thincam_jax._core.quantity import FieldError, quantity, whole
from thincam_jax.imaging.operators import Separable
from thincam_jax.imaging.operators.separable import SeparableModes
from thincam_jax.reconstruction.backgrounds import with_other_background
from thincam_jax.reconstruction.closed_normal import AbstractNormal, LevelledNormal, SeparableNormal
from thincam_jax.reconstruction.iterate import Outcome, outcome_of_run
from thincam_jax.reconstruction.normal_equations import IterativeNormal, normal_equations
from thincam_jax.reconstruction.outside_light import reaching_beyond
from thincam_jax.reconstruction.problem import (
    InverseProblem,
    or_one,
    residuals,
    scene_level,
    start_image,
)
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.scaled_problem import ScaledProblem
from thincam_jax.reconstruction.solver import AbstractSolver, Synthesis, as_synthesis, as_tolerance
from thincam_jax.reconstruction.unseen import filled_by_images

Rule = Literal["gcv", "sure", "likelihood"]

RULES: tuple[Rule, ...] = ("gcv", "sure", "likelihood")

# ρ is searched on a grid from 1e-12 to 1e4 of the largest eigenvalue of AᵀA, then between the
# neighbours of the best, twice: to 0.2 %.
_STEPS, _ZOOMS, _DECADES = 33, 3, (-12.0, 4.0)
_MASKED = 0.05  # of the pixels, which change ρ and the deviations as little


def _checked_ridge(name: str, ridge: Any) -> float | Rule:
    if isinstance(ridge, str):
        return cast(Rule, checks.choice(name, ridge, RULES))
    return float(checks.positive(name, ridge, "noise variance / image variance"))


class Ridge(AbstractSolver):
    """The posterior mean under a white prior, linear in the captures; it may be negative.

    Dense and separable operators are factorised, all others take conjugate gradients. `deviation`
    gives the error bars of its pixels.

    **Arguments**

    - `ridge`: noise variance over image variance, relative to that predicted by the captures' mean
      brightness. 1 suits pixels that vary independently by as much as their mean. More draws the
      image to its mean, less lets more noise into it. "gcv" (generalised cross-validation) and
      "sure" (Stein's unbiased estimate of the risk, with the noise variance of the recording)
      choose it from the captures of a separable camera of one term, for the least error of the
      image; "likelihood" (of the captures under the prior) as the image varies, for error bars.
    - `synthesis`: weights of the captures, see `AdmmTV`.
    - `iterations`: at most. `tolerance`: estimated distance of the minimiser over that between it
      and the uniform image. `reason` and `history[-1].primal` say what was not reached.

    **Errors**: ValueError, one line, for values out of range.

    ```python
    import numpy as np
    import thincam_jax as tc

    psf = np.random.default_rng(0).random((9, 9))
    recording = tc.Recording(np.ones((1, 24, 32)), tc.Psfs(psf[None]))
    result = tc.reconstruct(recording, tc.Ridge(1.0))
    ```

    **See also**: `AdmmTV`, `Wiener`.
    """

    name: ClassVar[str] = "ridge"
    ridge: float | Rule = eqx.field(static=True)
    correlation: tuple[float, ...] = eqx.field(static=True)
    synthesis: np.ndarray | None
    iterations: int = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)

    def __init__(
        self,
        ridge: Annotated[Number | str, quantity(check=_checked_ridge)] = 1.0,
        *,
        correlation: Number | Sequence[float | int] = 0.0,
        synthesis: Synthesis | None = None,
        iterations: Annotated[int, whole(1)] = 1000,
        tolerance: float = 1e-3,
    ):
        self.ridge = _checked_ridge("ridge", ridge)
        lengths = correlation if isinstance(correlation, tuple | list) else (correlation,)
        self.correlation = tuple(
            float(checks.non_negative("correlation", one, "pixels")) for one in lengths
        )
        if not self.correlation or (len(lengths) > 1 and not isinstance(self.ridge, str)):
            raise FieldError(
                f"correlation = {correlation} and ridge = {self.ridge}: give one length, or "
                'several and ridge="sure" or "gcv", which choose among them',
                "correlation",
            )
        self.synthesis = as_synthesis(synthesis)
        self.iterations = checks.whole("iterations", iterations, 1)
        self.tolerance = as_tolerance(tolerance)

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
        found = recording.reconstruction(outcome, self.name)
        if found.status == "iterations_exhausted":
            error = f"{outcome.history[-1].primal:.1g} of it, after {outcome.iterations} iterations"
            advice = "give more, a larger ridge, or double precision (JAX_ENABLE_X64=1)"
            return replace(found, reason=f"may differ from the minimiser by {error}: {advice}")
        return reaching_beyond(self.solve, recording, problem, outcome.image, found, self.synthesis)

    def deviation(self, recording: Recording) -> Float[Array, "*plane y x"]:
        r"""The posterior standard deviation of each pixel, in the scene's unit.

        .. math:: \sigma_i = \Big(\sum_k A_k^T w_k A_k + \rho\Big)^{-1/2}_{ii}

        the same for every capture of this noise. On average over all pixels, 95 % lie within
        1.96 σ of the truth if the noise variance is right and the image varies as in the prior:
        choose `ridge` by a rule, and a `correlation` for an image that is not white, whose errors
        a white prior overestimates. Components that the camera hardly transmits have the
        deviation of the prior, ρ^(−1/2). "gcv" and "sure" judge ρ by the other components alone:
        where pixels of the scene are finer than the sensor's take "likelihood". No rule tells
        whether such detail varies as the prior says: for white noise the intervals of a
        `correlation` of 1 are too small.

        **Errors**: ValueError for operators without a closed form: convolutions, several terms.
        """
        _, white, _, prior, precision = self._posed(recording)
        scaled = ScaledProblem(_of_one_weight(white))
        normal = normal_equations(scaled.problem, precision / scaled.curvature)
        if prior is not None:
            normal = prior.coloured(normal)
        return jnp.sqrt(normal.variance() / scaled.curvature)

    def _posed(self, recording):
        """The problem, the whitened problem, the mean, the prior and ρ."""
        # Sums in which the uniform light cancels do not show how bright the scene is; captures do.
        problem = recording.problem()
        level, mean = _uniform(problem)
        if self.synthesis is not None:
            problem = recording.problem(synthesis=self.synthesis)
        if problem.has_background:  # a linear method has no limits
            problem = with_other_background(problem, "unknown")
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


@jax.jit
def _uniform(problem: InverseProblem):
    """Level of the uniform image, and that image, not negative."""
    level = scene_level(problem)
    level = jnp.where(jnp.isfinite(level), level, 0)  # the solve reports such captures
    return level, jnp.maximum(level, 0)[..., None, None, None]


def _prior(problem: InverseProblem, correlation: float) -> "MarkovPrior | None":
    """The prior of this correlation; None if white, for any operator."""
    if correlation == 0:
        return None
    first = problem.operators[0]
    if len(problem.operators) > 1 or not isinstance(first, Separable):
        raise ValueError(
            f"correlation = {correlation:g} needs one separable camera; leave it out for a "
            f"{type(first).__name__}"
        )
    return MarkovPrior.of(first.in_shape, correlation, problem.captures[0].dtype)


def _whitened(problem: InverseProblem, mean, prior: "MarkovPrior") -> InverseProblem:
    """The problem of z, f = f̄ + L z."""
    (camera,) = problem.operators
    assert isinstance(camera, Separable)
    whitened = (prior.whitened(camera),)
    return eqx.tree_at(lambda p: p.operators, _about(problem, mean), whitened)


def _about(problem: InverseProblem, mean) -> InverseProblem:
    """The problem of f − f̄."""
    captures = tuple(-r for r in residuals(problem, mean))
    return eqx.tree_at(lambda p: p.captures, problem, captures)


def image_precision(level: Float[Array, "..."]) -> float:
    """1/s² of a scene of full contrast and this brightness; 1 if dark."""
    # In float64: squares of small brightnesses underflow in float32.
    variance = float(np.mean(np.asarray(level, dtype=np.float64) ** 2))
    return 1.0 / (variance if variance > 0 else 1.0)


def solve_ridge(
    problem: InverseProblem,
    *,
    precision: Number,
    mean: Float[Array, "..."] | None = None,
    iterations: int = 1000,
    tolerance: float = 1e-3,
) -> Outcome:
    """The ridge reconstruction of a problem; its τ, R and constraint are not used.

    One compiled program, without progress.

    **Arguments**

    - `precision`: ρ > 0, 1/variance of the image, where the weights are 1/variance of the noise.
    - `mean`: f̄, uniform if (*batch, channel, 1, 1, 1); default the uniform image that explains
      the captures.
    - `iterations`, `tolerance`: limits of conjugate gradients, see `Ridge`.
    """
    began = time.perf_counter()
    dtype = problem.captures[0].dtype
    rho = checks.positive("precision", precision, "1/variance of the image").astype(dtype)
    if mean is None or mean.shape != (*problem.image_shape[:-3], 1, 1, 1):
        mean = start_image(problem, mean)
    limit = jnp.asarray(tolerance, dtype)
    image, objectives, error, steps = _solve(problem, rho, mean, limit, iterations)
    outcome = outcome_of_run(
        mean, image, objectives, converged=bool(error <= limit), iterations=int(steps), began=began
    )
    before, after = outcome.history
    return replace(outcome, history=(before, replace(after, primal=float(error))))


@functools.partial(jax.jit, static_argnames="iterations")
def _solve(problem: InverseProblem, precision, mean, tolerance, iterations: int):
    about = _about(problem, mean)
    scaled = ScaledProblem(about)
    inside = scaled.problem
    normal = normal_equations(inside, precision / scaled.curvature)
    if isinstance(_without_level(normal), SeparableNormal):
        return _by_modes(about, scaled.curvature, normal, mean)
    if isinstance(normal, IterativeNormal):
        found = normal.least_squares(inside.captures, tolerance, iterations)
        change, explained, error, steps = found
    else:
        change, explained = normal.solve_captures(inside.captures)
        error, steps = jnp.sum(0 * change), jnp.asarray(1)
    pairs = zip(inside.weights, inside.captures, strict=True)
    before = sum(jnp.sum(w * c**2) for w, c in pairs) / 2
    # Of the minimiser, and of every iterate of conjugate gradients from zero; without another A f.
    after = jnp.maximum(before - explained / 2, 0)
    unit = (jnp.sqrt(scaled.curvature) * scaled.image_unit) ** 2
    return mean + change * scaled.image_unit, (unit * before, unit * after), error, steps


def _without_level(normal: AbstractNormal) -> AbstractNormal:
    return normal.known if isinstance(normal, LevelledNormal) else normal


def _by_modes(about: InverseProblem, curvature, normal: AbstractNormal, mean):
    """Ridge solution in closed form, scaled after the captures' modes are taken: no copies."""
    (capture,), weight = about.captures, about.weights[0].reshape(())
    known = _without_level(normal)
    assert isinstance(known, SeparableNormal)
    modes, operator_unit = known.modes, jnp.sqrt(curvature / or_one(weight))
    seen = modes.seen(capture)
    unit = or_one(jnp.max(jnp.abs(seen)))
    pulled = modes.values * (seen / unit)
    kept = pulled / (modes.values**2 + known.shift)
    if about.has_background:
        uniform, left = modes.uniform(), known.shift / (modes.values**2 + known.shift)
        size = math.prod(capture.shape[-2:]) - jnp.sum(uniform**2)
        level = _level(uniform, left, seen / unit, size)
        kept = kept - level * modes.values * uniform / (modes.values**2 + known.shift)
    image = mean + modes.image(kept)[..., None, :, :] * (unit / operator_unit)
    before = jnp.sum((capture / unit) ** 2) / 2
    after = jnp.maximum(before - jnp.sum(pulled * kept) / 2, 0)
    scale = weight * unit**2
    return image, (scale * before, scale * after), jnp.sum(0 * image), jnp.asarray(1)


def _level(uniform, left, seen, size) -> Float[Array, "*batch 1 1"]:
    """The uniform background of captures without a mean, with the image eliminated.

    - `uniform`, `seen`: modes of a capture of 1 and of the captures; `left`: the part of them that
      a ridge leaves. `size`: squares of a capture of 1 outside of the modes.
    """
    found = jnp.sum(uniform * (left - 1) * seen, axis=(-2, -1), keepdims=True)
    return found / or_one(size + jnp.sum(left * uniform**2))


@jax.jit
def ridge_by_modes(
    modes: SeparableModes, captures: Float[Array, "*batch y x"], precision: Float[Array, ""]
) -> Float[Array, "*batch m n"]:
    """The ridge reconstruction with mean 0, for captures whose noise has variance 1.

    Four matrix products a capture: for videos and channels of one camera, whose modes
    `Separable.with_modes` keeps. `Ridge` does the same for a recording, with its mean.

    - `precision`: ρ > 0, 1/variance of the image where noise has variance 1.
    """
    seen = modes.seen(captures)
    inside = seen * modes.values / (modes.values**2 + precision)
    return modes.image(inside)


class MarkovPrior(eqx.Module):
    r"""Prior of correlated pixels: covariance e^{−|y−y'|/ℓ − |x−x'|/ℓ} over ρ.

    The product of two Markov chains, the usual model of photographs (Jain, Proc. IEEE 69, 349,
    1981). It is L Lᵀ with the lower triangular L = `rows` ⊗ `columns`, so that z = L⁻¹(f − f̄) is
    white and a separable camera of f is one of z.
    """

    rows: Float[Array, "m m"]
    columns: Float[Array, "n n"]

    @classmethod
    def of(cls, shape: tuple[int, int], correlation: float, dtype: DTypeLike) -> "MarkovPrior":
        """The prior of images of a shape. `correlation`: ℓ ≥ 0, pixels; 0 is white."""
        near = math.exp(-1 / correlation) if correlation > 0 else 0.0

        def root(count):
            steps = np.subtract.outer(np.arange(count), np.arange(count))
            chain = np.where(steps >= 0, near ** np.abs(steps), 0)
            chain[:, 1:] *= math.sqrt(1 - near**2)
            return jnp.asarray(chain, dtype)

        return cls(root(shape[0]), root(shape[1]))

    def whitened(self, operator: Separable) -> Separable:
        """The operator of the white image z."""
        return Separable(
            product(operator.left, self.rows), product(operator.right, self.columns)
        ).with_modes()

    def image(self, white: Float[Array, "*batch m n"]) -> Float[Array, "*batch m n"]:
        """L z."""
        return product(product(self.rows, white), self.columns.T)

    def coloured(self, normal: AbstractNormal) -> AbstractNormal:
        """The normal equations of z with their solutions as images, for the variance."""
        if isinstance(normal, LevelledNormal):
            parts = self.coloured(normal.known), self.image(normal.taken)
            return eqx.tree_at(lambda one: (one.known, one.taken), normal, parts)
        if isinstance(normal, SeparableNormal):
            return replace(normal, modes=self.modes(normal.modes))
        return normal

    def modes(self, modes: SeparableModes) -> SeparableModes:
        """Modes of z as images: modes for `ridge_by_modes` under this prior."""
        return replace(
            modes, rows=product(self.rows, modes.rows), columns=product(self.columns, modes.columns)
        )


def _of_one_weight(problem: InverseProblem) -> InverseProblem:
    """A problem whose few masked pixels behind a separable camera are what an image casts."""
    (operator, *others), (weight, *_) = problem.operators, problem.weights
    if others or not isinstance(operator, Separable) or weight.size == 1 or is_traced(weight):
        return problem
    valid, most = weight > 0, jnp.max(weight)
    if not bool(jnp.all((weight == most) | ~valid) & (jnp.mean(valid) > 1 - _MASKED)):
        return problem
    filled = filled_by_images(operator, problem.captures[0], valid)
    return eqx.tree_at(lambda p: (p.captures, p.weights), problem, ((filled,), (most,)))


def choose_precision(
    problem: InverseProblem, mean: Image, rule: Rule
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """ρ of least GCV or SURE, one for all batch elements and channels, and that least value.

    - `mean`: f̄ of the ridge.

    **Errors**: ValueError unless the problem is of one separable term with one weight.
    """
    checks.choice("rule", rule, RULES)
    problem, unit = _of_one_weight(problem), jnp.ones((), problem.captures[0].dtype)
    normal = _without_level(normal_equations(problem, unit))
    if not isinstance(normal, SeparableNormal):
        raise ValueError(
            f"ridge = {rule!r} needs the modes of one separable term with one weight; give a "
            "number, or one term (truncated(terms=1).operator) and few dead pixels"
        )
    (difference,) = residuals(problem, mean)
    weighted = -jnp.sqrt(problem.weights[0]) * difference
    return _least(normal.modes, weighted, rule, problem.has_background)


@functools.partial(jax.jit, static_argnames=("rule", "has_level"))
def _least(modes: SeparableModes, captures, rule: Rule, has_level: bool):
    """The minimum over log ρ, by three grids of decreasing range.

    - `has_level`: whether a uniform background of each image is found, for each ρ.
    """
    seen = modes.seen(captures)
    power = (modes.values / jnp.max(modes.values)) ** 2
    assert modes.seen_rows is not None and modes.seen_columns is not None
    beyond = captures - product(product(modes.seen_rows, seen), modes.seen_columns.T)
    images, batch = captures.size // math.prod(captures.shape[-2:]), tuple(range(seen.ndim - 2))
    count, uniform = captures.size, modes.uniform()
    outside, squares = jnp.sum(beyond**2), jnp.sum(seen**2, axis=batch)
    beyond = jnp.sum(beyond, axis=(-2, -1), keepdims=True)
    size = count // images - jnp.sum(uniform**2)  # of a capture of 1, outside of the modes

    def without_level(left):
        """Squares of captures less their background, in the modes, and outside of them."""
        level = _level(uniform, left, seen, size)
        inside = jnp.sum((seen - level * uniform) ** 2, axis=batch)
        return inside, outside - jnp.sum(level * (2 * beyond - level * size))

    def criterion(exponent):
        # Left of a mode; 1/left is its variance in captures, 1 + s²t²/ρ, under the prior.
        left = 10.0**exponent / (power + 10.0**exponent)
        inside, rest = without_level(left) if has_level else (squares, outside)
        if rule == "likelihood":
            return jnp.sum(inside * left) - images * jnp.sum(jnp.log(left)) + rest
        residual = jnp.sum(inside * left**2) + rest
        freedom = images * jnp.sum(power / (power + 10.0**exponent))
        if rule == "gcv":
            # Avoids 0/0 if nothing is filtered out.
            return count * residual / jnp.maximum(count - freedom, 0.5) ** 2
        return residual - count + 2 * freedom

    lower, upper = _DECADES
    lower, upper = (jnp.asarray(e, captures.dtype) for e in (lower, upper))
    for _ in range(_ZOOMS):
        tried = jnp.linspace(lower, upper, _STEPS, dtype=captures.dtype)
        best = jnp.argmin(jax.lax.map(criterion, tried)).astype(jnp.int32)
        lower, upper = tried[jnp.maximum(best - 1, 0)], tried[jnp.minimum(best + 1, _STEPS - 1)]
    middle = (lower + upper) / 2
    return jnp.max(modes.values) ** 2 * 10.0**middle, criterion(middle)
