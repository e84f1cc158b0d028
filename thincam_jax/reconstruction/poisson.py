r"""Reconstruction from few photons: the Poisson likelihood of counts, by L-BFGS.

Counts y of a mean m = Hf + b, with a known background b (dark counts, stray light), have

.. math:: -\log L = \sum_k w_k \Big(m_k - y_k + y_k \log\frac{y_k}{m_k}\Big) + \mathrm{const},

half of the deviance. With total variation and f ≥ 0 that is minimised,

.. math:: E(f) = -\log L + \tau\, TV_\epsilon(f),\qquad f = s\,\varphi(\theta) > 0,

over θ, with φ one of the links of `LINKS` and s the brightness of the uniform image. TV is smoothed
by its Moreau envelope (a Huber function of the length of each vector of differences), so
that E has a gradient. At high counts this agrees with least squares of weights 1/y; at a few
counts a pixel it does not.
"""

import functools
import time
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.quantity import whole
from thincam_jax.reconstruction.imaging_model import Cameras, distance_ratios
from thincam_jax.reconstruction.iterate import Callback, Outcome, outcome_of_run
from thincam_jax.reconstruction.outside_light import covering, reaching_beyond
from thincam_jax.reconstruction.problem import (
    InverseProblem,
    backprojected_noise,
    detector_shape,
    forward,
    start_image,
    uniform_level,
)
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.solver import (
    DEFAULT_TAU,
    AbstractIterativeSolver,
    as_tolerance,
    as_variation,
    first_image,
    of_kind,
)
from thincam_jax.reconstruction.total_variation import TotalVariation

# Smoothing of the variation over the mean brightness. At 0.01 high counts are smoothed visibly more
# than by `AdmmTV`; at 0.001 the two agree as well as their weights allow, in twice the steps.
_SMOOTHING = 0.001

Link = Literal["softplus", "exponential", "square"]
LINKS: tuple[Link, ...] = ("softplus", "exponential", "square")


class Counts(eqx.Module):
    """A problem of photon counts, with its background.

    - `problem`: its captures are counts (photo-electrons, not digital numbers), background
      included; of its weights only 0 counts, in dead or saturated pixels. Its regulariser is total
      variation, with τ in the unit of `counts_problem`.
    - `background`: b of each capture, counts; default none.
    - `smoothing`: ε of TV over s: smaller differences are smoothed, not kept as edges.
    - `link`: φ: "softplus", log(1 + e^θ); "exponential"; "square", θ².
    - `unit`: s, (*batch, 1, 1, 1, 1), brightness at which θ is about 1.
    - `floor`: least mean count of a pixel, so that log m exists.

    **Errors**: ValueError, one line, for negative counts and backgrounds that do not fit.
    """

    problem: InverseProblem
    background: tuple[Float[Array, "..."], ...]
    unit: Float[Array, "*batch 1 1 1 1"]
    smoothing: Number
    floor: Float[Array, ""]
    link: Link = eqx.field(static=True)

    def __init__(
        self,
        problem: InverseProblem,
        *,
        background: Sequence[Numbers] | None = None,
        smoothing: Number = 0.01,
        link: Link = "softplus",
    ):
        checks.choice("link", link, LINKS)
        dtype = problem.captures[0].dtype
        _check_counts(problem)
        given = [0.0] * len(problem.captures) if background is None else background
        if len(given) != len(problem.captures):
            raise ValueError(
                f"{len(given)} backgrounds for {len(problem.captures)} captures; give one for each"
            )
        of_kind("regulariser", problem.regulariser, TotalVariation)
        self.problem, self.link = counts_problem(problem), link
        self.background = tuple(jnp.asarray(b, dtype) for b in given)
        self.smoothing = checks.positive("smoothing", smoothing, "parts of the mean").astype(dtype)
        self.unit, self.floor = _unit(problem, self.background)

    def image(self, theta: Image):
        """The image f of θ."""
        return self.unit * positive(self.link, theta.astype(self.unit.dtype))

    def theta(self, image: Image):
        """θ of an image, whose values are raised to at least s/1000.

        In the default precision, in which the solver keeps its memory.
        """
        theta = unlinked(self.link, jnp.maximum(image / self.unit, 1e-3))
        return theta.astype(jnp.result_type(float))


def _number(tau: Any) -> Float[Array, ""]:
    if isinstance(tau, str):
        raise ValueError(f"tau = {tau!r} is for Gaussian noise only; give a number, about 1 to 3")
    return checks.non_negative("tau", tau, "a ratio")


class PoissonTV(AbstractIterativeSolver):
    """The most probable image of counts, with total variation: for few photons a pixel.

    **Arguments**

    - `tau`: weight of the variation relative to the noise of each capture's mean count, which is
      the same as that of `AdmmTV` where counts are high.
    - `variation`: see `TotalVariation`.
    - `background`: dark counts within the captures, one number, or for each capture one number or
      one a pixel; default none.
    - `iterations`: at most. `tolerance`: relative change of objective and image at which to end.

    The captures are counts (photo-electrons), and so have no synthesis: differences are not. It
    takes no callback, since it is one compiled program.

    **Errors**: ValueError, one line, for values out of range.

    ```python
    import numpy as np
    import thincam_jax as tc

    psf = np.random.default_rng(0).random((9, 9))
    counts = np.random.default_rng(1).poisson(20.0, (1, 24, 32)).astype(float)
    recording = tc.Recording(counts, tc.Psfs(psf[None]))
    result = tc.reconstruct(recording, tc.PoissonTV(iterations=10))
    ```

    **See also**: `AdmmTV`.
    """

    name: ClassVar[str] = "poisson"
    tau: Float[Array, ""] = eqx.field(default=DEFAULT_TAU, converter=_number)
    variation: TotalVariation = eqx.field(default=None, converter=as_variation, kw_only=True)
    background: Any = eqx.field(default=None, kw_only=True)
    iterations: int = eqx.field(default=300, converter=whole(1), static=True, kw_only=True)
    tolerance: float = eqx.field(default=1e-4, converter=as_tolerance, static=True, kw_only=True)

    def solve(
        self,
        recording: Recording,
        *,
        start: Float[Array, "..."] | None = None,
        callback: Callback | None = None,
    ):
        if callback is not None:
            raise ValueError("method 'poisson' runs in one piece; leave out the callback")
        recording = covering(recording, start)
        model = recording.imaging_model
        if isinstance(model, Cameras) and not model.over_field:
            if max(distance_ratios(model.cameras)) > 1:
                raise ValueError(
                    "method 'poisson' needs all cameras at one distance, since enlarged captures "
                    "are no counts; use AdmmTV, or a model with a field_tolerance"
                )
        # The variance is that of the counts, and need not be estimated.
        counted = recording.with_noise(1.0)
        if recording.background is None:  # the solver's own is known
            counted = counted.with_background(0.0)
        problem = counted.problem(tau=self.tau, regulariser=self.variation)
        image = None
        if start is not None:
            image = first_image(problem, recording.oriented(start), uniform=True)
        background = _backgrounds(self.background, problem)
        outcome = solve_poisson(
            Counts(problem, background=background, smoothing=_SMOOTHING),
            image=image,
            iterations=self.iterations,
            tolerance=self.tolerance,
        )
        result = recording.reconstruction(outcome, self.name, float(self.tau))
        if not isinstance(model, Cameras) or problem.image_shape[-3] > 1:
            return result
        found = recording.problem()  # with noise that is found
        solve = functools.partial(self.solve, start=start)
        return reaching_beyond(solve, recording, found, outcome.image, result)


def solve_poisson(
    counts: Counts,
    *,
    image: Float[Array, "..."] | None = None,
    iterations: int = 300,
    tolerance: float = 1e-4,
    memory: int = 10,
) -> Outcome:
    """The most probable image of counts, by L-BFGS (optimistix), always non-negative.

    One compiled program, without progress.

    **Arguments**

    - `counts`: the problem with its background, link and smoothing.
    - `image`: to start from; default the uniform image.
    - `tolerance`: relative change of the objective and of θ at which to end.
    - `memory`: number of steps that L-BFGS keeps.

    **Errors**: ValueError, one line, for a start image of another shape.
    """
    began, problem = time.perf_counter(), counts.problem
    uniform = jnp.broadcast_to(counts.unit, problem.image_shape)
    start = uniform if image is None else start_image(problem, image)
    limit = jnp.asarray(tolerance, float)
    solution = optimistix.minimise(
        poisson_loss,
        optimistix.LBFGS(rtol=limit, atol=limit, history_length=memory),  # type: ignore[arg-type]
        counts.theta(start),
        args=counts,
        max_steps=iterations,
        throw=False,
    )
    found = counts.image(solution.value)
    return outcome_of_run(
        start,
        found,
        [poisson_objective(counts, image) for image in (start, found)],
        converged=bool(solution.result == optimistix.RESULTS.successful),
        iterations=int(solution.stats["num_steps"]),
        began=began,
    )


def poisson_loss(theta: Float[Array, "..."], counts: Counts) -> Float[Array, ""]:
    """E of f(θ), summed over the batch."""
    return jnp.sum(poisson_objective(counts, counts.image(theta))).astype(theta.dtype)


@jax.jit
def poisson_objective(counts: Counts, image: Image) -> Float[Array, "*batch"]:
    """−log L + τ TV_ε of each batch element."""
    parts = [
        jnp.sum(w * half_deviance(y, m), axis=tuple(range(-1 - len(detector_shape(o)), 0)))
        for o, w, y, m in zip(
            counts.problem.operators,
            counts.problem.weights,
            counts.problem.captures,
            mean_counts(counts, image),
            strict=True,
        )
    ]
    scale = counts.unit[..., 0, 0, 0, 0]
    variation = counts.problem.regulariser
    assert isinstance(variation, TotalVariation)  # of `Counts`
    rough = smooth_variation(variation, image / counts.unit, counts.smoothing)
    return sum(parts[1:], start=parts[0]) + counts.problem.absolute_tau * scale * rough


def mean_counts(counts: Counts, image: Image):
    """m = Hf + b of each capture."""
    return tuple(
        # Rounding in the transforms can bring a dark pixel below zero.
        jnp.maximum(forward(operator, image), 0) + b + counts.floor
        for operator, b in zip(counts.problem.operators, counts.background, strict=True)
    )


def half_deviance(counts: Float[Array, "..."], mean: Float[Array, "..."]) -> Float[Array, "..."]:
    """m − y + y log(y/m), m where y = 0; without cancellation where m is near y."""
    seen = counts > 0
    safe = jnp.where(seen, counts, 1)
    excess = jnp.where(seen, (mean - counts) / safe, 0)
    return jnp.where(seen, safe * (excess - jnp.log1p(excess)), mean)


def smooth_variation(
    variation: TotalVariation, image: Image, smoothing: Number
) -> Float[Array, "*batch"]:
    r"""The Moreau envelope of TV's norm: min over u of φ(u) + ‖u − Ψf‖²/(2ε).

    It is below TV by at most ε/2 at each place, and equal to ‖Ψf‖²/(2ε) where differences are
    shorter than ε. With u the minimiser φ(u) = ⟨u, Ψf − u⟩/ε, since φ is a norm.
    """
    slopes = variation.analyse(image)
    kept = variation.shrink(slopes, smoothing)
    pairs = list(zip(slopes, kept, strict=True))
    total = sum(u * (s - u) + (s - u) ** 2 / 2 for s, u in pairs)
    return jnp.sum(total, axis=(-4, -3, -2, -1)) / smoothing


def positive(link: Link, theta: Float[Array, "..."]) -> Float[Array, "..."]:
    """φ(θ)."""
    if link == "softplus":
        return jax.nn.softplus(theta)
    return jnp.exp(theta) if link == "exponential" else theta**2


def unlinked(link: Link, value: Float[Array, "..."]) -> Float[Array, "..."]:
    """θ with φ(θ) = value > 0."""
    if link == "softplus":
        return value + jnp.log(-jnp.expm1(-value))
    return jnp.log(value) if link == "exponential" else jnp.sqrt(value)


@jax.jit
def _unit(problem: InverseProblem, background):
    captures = tuple(c - b for c, b in zip(problem.captures, background, strict=True))
    level = uniform_level(eqx.tree_at(lambda p: p.captures, problem, captures))
    level = jnp.mean(jnp.maximum(level, 0), axis=-1)
    # Without any count, the brightness that gives one in each capture.
    uniform = jnp.ones(problem.image_shape[-4:], level.dtype)
    light = sum(jnp.sum(forward(operator, uniform)) for operator in problem.operators)
    least = jnp.where(light > 0, 1 / jnp.where(light > 0, light, 1), 1)
    mean = jnp.mean(jnp.stack([jnp.mean(c) for c in problem.captures]))
    unit = jnp.maximum(level, least)[..., None, None, None, None]
    return unit, jnp.maximum(1e-6 * mean, 1e-6)


def _check_counts(problem: InverseProblem) -> None:
    for capture in problem.captures:
        # Simulated means may be negative by rounding.
        rounding = 1e-6 * jnp.max(jnp.abs(capture))
        if not checks.is_traced(capture) and bool((capture < -rounding).any()):
            raise ValueError(
                f"a capture has negative counts, the least {float(capture.min()):.3g}; give raw "
                "counts, and the dark level as background"
            )


def counts_problem(problem: InverseProblem) -> InverseProblem:
    """The problem with weights of 1, or 0 where a pixel is not trusted, and τ of its counts.

    Near its minimum half the deviance of counts y is :math:`(m - y)^2 / (2y)`: least squares with
    the weights 1/y. The unit of τ is therefore that of weights 1/(mean count), background included.
    """
    pairs = list(zip(problem.captures, problem.weights, strict=True))
    captures = tuple(jnp.where(w > 0, c, 0) for c, w in pairs)
    weights = tuple((w > 0).astype(c.dtype) for c, w in pairs)
    means = [mean_count(c, w) for c, w in zip(captures, weights, strict=True)]
    unit = backprojected_noise(problem.operators, [1 / mean for mean in means])
    return eqx.tree_at(
        lambda p: (p.captures, p.weights, p.tau_unit),
        problem,
        (captures, weights, unit.astype(problem.tau_unit.dtype)),
    )


def mean_count(capture: Float[Array, "..."], weight: Float[Array, "..."]) -> Float[Array, ""]:
    """The mean over the trusted pixels, which is their variance; 1 if there is no count."""
    trusted = jnp.isfinite(capture) & (weight > 0)
    mean = jnp.sum(jnp.where(trusted, capture, 0)) / jnp.maximum(
        jnp.sum(trusted.astype(capture.dtype)), 1
    )
    return jnp.where(mean > 0, mean, 1)


def _backgrounds(background, problem: InverseProblem) -> list[Float[Array, "..."]] | None:
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
        raise ValueError(f"background {background!r} is not a number; give dark counts") from None
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
