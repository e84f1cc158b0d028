r"""Plug and play: data steps of a camera's model alternate with a denoiser that knows no camera.

Half-quadratic splitting (Zhang et al., DPIR, IEEE Trans. Pattern Anal. 44, 6360, 2022):

.. math:: z = \arg\min_z \tfrac12 \sum_k w_k (A_k z - g_k)^2 + \tfrac1{2 s^2} \|z - f\|^2,
    \qquad f = D(z, \sigma)

with w = 1/variance and a deviation s of the prior that falls from step to step. With
:math:`M = A^T w A + s^{-2}` the noise of z has the covariance :math:`M^{-1} A^T w A M^{-1}`: a mode
that the camera transmits with the precision h gets the deviation :math:`\sqrt h/(h + s^{-2})`, at
most s/2. σ is the largest of a ring of frequencies, since a denoiser sees a neighbourhood; s/2 for
several planes, and where the modes are not frequencies. The shipped denoiser was trained inside
these steps, behind drawn cameras (`thincam_jax.learn.denoiser.reconstructions`). A last data step,
with s/4, gives back what the denoiser took from modes that the captures know well.
"""

import dataclasses
import functools
import math
import os
import time
import warnings
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.precision import AccuracyWarning
from thincam_jax._core.quantity import quantity, whole
from thincam_jax.learn.denoiser.network import SHIPPED, Denoiser
from thincam_jax.learn.residual_noise import ResidualNoise, detail_variances, residual_noise
from thincam_jax.reconstruction.iterate import Callback, Outcome, Progress, Status
from thincam_jax.reconstruction.normal_equations import (
    INNER_STEPS,
    AbstractNormal,
    DenseNormal,
    IterativeNormal,
    normal_equations,
    padded_field,
)
from thincam_jax.reconstruction.outside_light import covering, reaching_beyond
from thincam_jax.reconstruction.parallel import independent_parts
from thincam_jax.reconstruction.problem import (
    InverseProblem,
    back_projected,
    brightness,
    convolutions,
    detector_shape,
    misfit,
    or_one,
    uniform_image,
)
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularised import AdmmTV, starts_uniform
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.scaled_problem import ScaledProblem
from thincam_jax.reconstruction.solver import (
    AbstractIterativeSolver,
    as_synthesis,
    as_tolerance,
    first_image,
)
from thincam_jax.reconstruction.total_variation import TotalVariation

# s falls from twice the brightness of the image to a 24th of it; given a start, from 0.6 of twice
# its root mean square, but a quarter of the first at least, as in a dark room. From once the
# brightness dark images at 20 dB stay 1.5 dB below.
_FIRST, _LAST, _WARM, _LEAST_WARM = 2, 1 / 48, 0.6, 1 / 4
# Width of the rings, cycles per pixel. Narrower ones gain less. Wider ones leave noise in a band:
# method A loses 0.3 dB of a photograph with rings four times as wide, 3 dB with the mean of all.
_RING = 1 / 64
# Of s, since what f has wrong stays in z. Without it a dark room loses 0.1 dB at 100 electrons.
_LEAST_NOISE = 0.4
STEPS = 5  # in which the shipped denoiser was trained
# Of s in the last data step. It gains a FlatCam up to 5 dB.
FINAL = 0.25
# Part of its value to which s falls with each further step, how many there are, and χ² of a pixel
# that ends them: three times the noise. They halve the residual of bright captures, and gain no
# more below.
_FALL, _FURTHER, _EXPLAINED = 0.58, 8, 10
# Weight, iterations and tolerance of the image by total variation from which several planes begin,
# and fields with as many pixels as the captures: what captures hardly show takes too many data
# steps. It gains a dark room at 40 dB up to 15 dB. It is made again where its noise is not the same
# to such a factor: half of the weight loses up to 3 dB.
_TAU, _ITERATIONS, _TOLERANCE, _SAME = 1.0, 150, 3e-5, 1.5
# s, relative to the first, that shows the noise of that image: dark rooms explain any noise with
# more, and with less what total variation takes from planes at 40 dB counts as noise.
_FITTED = 0.15
# Error of a data step by conjugate gradients, as a part of the noise of Aᵀg.
_STEP_ERROR = 0.05
# Least μ of the normal equations, in units of the precision's rounding, where ‖A‖ = 1: with less,
# as of captures with over 45 dB in single precision, they are not solved, and images explode.
_LEAST_SHIFT = 64
_Kind = Literal["far", "near", "fitted"]  # images that a run begins with
_UNIT = 4  # steps of the power method for a unit, which needs to be no closer than that


def as_denoiser(denoiser: Any) -> Any:
    """A denoiser, or that of a file."""
    if callable(denoiser):
        return denoiser
    known = isinstance(denoiser, str | os.PathLike)
    if not known or not (denoiser == SHIPPED or os.path.isfile(denoiser)):
        raise ValueError(
            f"denoiser = {str(denoiser)[:60]!r}: give 'shipped', a file of thincam train, or a "
            "function of images and the deviation of their noise"
        )
    return Denoiser.load(denoiser)


class PlugAndPlay(AbstractIterativeSolver):
    """Least squares with a trained denoiser as its prior; any camera, crop included.

    Nothing is to be tuned. The noise is taken as the recording tells, corrected by up to four times
    where the residual of the first data step is another; pixels are weighted where it grows with
    the light, as photon noise does, behind convolutions. Each image, colour and plane is denoised
    by itself. Several planes, and fields with as many pixels as the captures, begin with `AdmmTV`.
    What the denoiser has not learned, such as fine texture, may be lost, and what looks like an
    edge be made up.

    **Arguments**

    - `denoiser`: "shipped", a file of `thincam train`, or a function of images (*batch, y, x) and
      their noise's deviation.
    - `strength`: σ relative to the one found; more gives smoother images, less leaves noise.
    - `nonnegative`: whether to constrain f ≥ 0.
    - `synthesis`: weights of the captures, see `AdmmTV`.
    - `iterations`: data steps after the first one, in which s falls. Up to eight more follow
      where the residual is still over three times the noise, as of very bright captures.
    - `tolerance`: change in the last one, relative to an image's length, that counts as converged.

    **Errors**: ValueError, one line, for values out of range; CheckpointError for a damaged file.

    ```python
    import numpy as np
    import thincam_jax as tc

    psf = np.random.default_rng(0).random((9, 9))
    recording = tc.Recording(np.ones((1, 24, 32)), tc.Psfs(psf[None]), noise_variance=0.01)
    result = tc.reconstruct(recording, tc.PlugAndPlay(iterations=2))
    ```

    **See also**: `reconstruct`, `AdmmTV`.
    """

    name: ClassVar[str] = "pnp"
    denoiser: Any = eqx.field(default=SHIPPED, converter=as_denoiser)
    strength: Float[Array, ""] = eqx.field(
        default=1.0, converter=quantity("a ratio", positive=True), kw_only=True
    )
    nonnegative: bool = eqx.field(default=True, converter=bool, static=True, kw_only=True)
    synthesis: np.ndarray | None = eqx.field(default=None, converter=as_synthesis, kw_only=True)
    iterations: int = eqx.field(default=STEPS, converter=whole(1), static=True, kw_only=True)
    tolerance: float = eqx.field(default=3e-3, converter=as_tolerance, static=True, kw_only=True)

    def solve(
        self,
        recording: Recording,
        *,
        start: Float[Array, "..."] | None = None,
        callback: Callback | None = None,
    ):
        """Reconstruct; with a start image that is not dark s begins lower."""
        began, recording = time.perf_counter(), covering(recording, start)
        apart = TotalVariation(coupling="none")  # colours
        # Data steps are linear, and so without a constraint.
        problem = recording.problem(regulariser=apart, nonnegative=False, synthesis=self.synthesis)
        parts = _parts(problem)
        bright = 1.0 if starts_uniform(recording, problem) else 0.0
        images = [bright * uniform_image(part) for part in parts]
        warm = False
        if start is not None:
            image = first_image(problem, recording.oriented(start), uniform=True)
            warm = bool(jnp.any(image > 0))
            images = _split(image, parts) if warm else images
        history: list[Progress] = []
        status: Status = "iterations_exhausted"
        runs: list[_Run] = []
        try:
            if not warm and _is_slow(problem):
                self._begin_smooth(recording, parts, images, runs)
            else:
                self._begin(parts, images, "near" if warm else "far", runs)
            for number in range(self.iterations + _FURTHER + 1):
                for run in runs:
                    run.advance(number)
                progress = Progress(
                    number,
                    sum(run.misfit for run in runs),
                    max(run.gap for run in runs),
                    max(run.change for run in runs),
                )
                if not math.isfinite(progress.objective):
                    status = "non_finite"
                    break
                history.append(progress)
                if number >= self.iterations and all(run.is_explained for run in runs):
                    status = "converged" if progress.dual < self.tolerance else status
                    break
                if callback is not None and callback(progress):
                    status = "stopped"
                    break
            if status != "non_finite":
                for run in runs:
                    run.finish()
        except KeyboardInterrupt:
            status = "interrupted"
        images = [run.result for run in runs] + images[len(runs) :]
        done, seconds = max(len(history) - 1, 0), time.perf_counter() - began
        whole_image = jnp.stack(images).reshape(problem.image_shape)
        outcome = Outcome(whole_image, status, tuple(history), done, seconds)
        result = recording.reconstruction(outcome, self.name)
        if status not in ("converged", "iterations_exhausted"):
            return result
        solve = functools.partial(self.solve, start=start, callback=callback)
        return reaching_beyond(solve, recording, problem, whole_image, result, self.synthesis)

    def _begin(self, parts: list[InverseProblem], images: list[Image], kind: _Kind, runs: list):
        """Begin the runs of parts, one after the other; anew those that there are."""
        for number, (part, image) in enumerate(zip(parts, images, strict=True)):
            is_new = number == len(runs)
            run = _Run(self, part, runs[0].given if runs else None) if is_new else runs[number]
            run.begin(image, kind)
            if is_new:
                runs.append(run)

    def _begin_smooth(
        self,
        recording: Recording,
        parts: list[InverseProblem],
        images: list[Image],
        runs: list["_Run"],
    ):
        """Begin the runs with images by total variation, once more if the noise was another."""
        mistake, start = 1.0, None
        for _ in range(2):
            first = AdmmTV(
                _TAU * mistake,
                nonnegative=self.nonnegative,
                synthesis=self.synthesis,
                iterations=_ITERATIONS,
                tolerance=_TOLERANCE,
            )
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", AccuracyWarning)  # the problem above gave them
                begun = first.whole_field(recording, start)
            start = recording.oriented(begun.image)
            images[:] = _split(begun.image, parts)
            self._begin(parts, images, "fitted", runs)
            if begun.status == "interrupted":
                raise KeyboardInterrupt
            before, mistake = mistake, max(run.mistake for run in runs)
            if max(mistake / before, before / mistake) < _SAME:
                return


class _Run:
    """The iteration of one image: `result` is the last finite one, `mistake` that of the noise."""

    def __init__(self, solver: PlugAndPlay, problem: InverseProblem, like: AbstractNormal | None):
        scaled = ScaledProblem(problem, iterations=_UNIT, whole=True)
        self.solver, self.unit = solver, scaled.image_unit
        # 1/variance of a capture in these units, and the weights, as they were given.
        self.given_precision = scaled.curvature * scaled.image_unit**2
        self.given = _normal(scaled.problem, jnp.ones_like(self.given_precision), like)
        self.misfit = self.gap = self.change = math.nan

    def begin(self, image: Image, kind: _Kind) -> None:
        """The first data step, and the noise, from an image far from the one sought, or near it.

        Of one that is "fitted" to the captures, a data step with less s shows the noise.
        """
        warm = kind in ("near", "fitted")
        self._take(self.given)
        self.result, self.image = image, image / self.unit
        if warm:
            seen = brightness(self.image)
            spread = float(jnp.sqrt(jnp.mean(self.image**2)) / or_one(seen))
            first = max(_WARM * spread, _LEAST_WARM)
        else:
            seen, first = jnp.max(uniform_image(self.problem)), 1.0
        self.largest = or_one(_FIRST * seen)
        self.course = course(self.solver.iterations, first)
        self.precision = self.given_precision
        self._step(self.largest * (_FITTED if kind == "fitted" else self.course[0]))
        noise = self._noise()
        self.mistake = float(noise.mistake)
        variances = noise.variances if bool(noise.grows) else ()
        if not variances and not bool(noise.tells):
            variances = detail_variances(self.problem)
        if variances:
            self._weigh(variances)
            self._step(self.s)
            noise = self._noise()
        self.precision = self.precision / noise.mistake**2
        if kind == "fitted":
            self._step(self.largest * self.course[0])

    @property
    def problem(self) -> InverseProblem:
        """Inverse problem in units in which A has the norm 1."""
        return self.normal.problem

    def _noise(self) -> ResidualNoise:
        return residual_noise(self.normal, self.found, self.shift, self.precision)

    def _weigh(self, variances: tuple[Array, ...]) -> None:
        """Weights of pixels by their variances."""
        pairs = zip(self.problem.weights, variances, strict=True)
        weights = tuple(w / v for w, v in pairs)
        weighted = eqx.tree_at(lambda p: p.weights, self.problem, weights)
        self._take(normal_equations(weighted, self.shift))

    def _take(self, normal: AbstractNormal) -> None:
        self.normal, self.right = normal, back_projected(normal.problem, normal.problem.captures)

    def advance(self, number: int) -> None:
        """Data step, but for the first one, and denoiser."""
        solver = self.solver
        if number > solver.iterations:
            if self.is_explained:
                return
            self._step(self.s * _FALL)
        elif number:
            self._step(self.largest * self.course[number - 1])
        if not bool(jnp.isfinite(self.found).all()):
            self.misfit = math.nan
            return
        noise = largest_noise(self.normal, self.shift, self.precision)
        sigma = jnp.broadcast_to(solver.strength.astype(noise.dtype) * noise, self.found.shape[:-2])
        image = solver.denoiser(self.found, sigma)
        image = jnp.maximum(image, 0) if solver.nonnegative else image
        chi, gap, change = _judged(self.problem, self.precision, self.image, self.found, image)
        if number == 0:
            self.largest = largest_deviation(image)
        self.misfit, self.gap, self.change = (float(x) for x in (chi, gap, change))
        if math.isfinite(self.misfit):
            self.image, self.result = image, image * self.unit

    @property
    def is_explained(self) -> bool:
        """Whether the image differs from the captures by little more than their noise."""
        return 2 * self.misfit < _EXPLAINED * sum(c.size for c in self.problem.captures)

    def finish(self) -> None:
        """One more data step."""
        self._step(self.s * FINAL)
        image = jnp.maximum(self.found, 0) if self.solver.nonnegative else self.found
        self.result = jnp.where(jnp.isfinite(image).all(), image * self.unit, self.result)

    def _step(self, s: Float[Array, ""]) -> None:
        """`found`, z of a data step with s."""
        self.s, self.shift = s, shift_of(s, self.precision)
        self.found = data_step(self.normal, self.right, self.image, self.shift, self.precision)


def shift_of(s: Float[Array, ""], precision: Float[Array, ""]) -> Float[Array, ""]:
    """μ of the normal equations, as large as they need to be solved."""
    return jnp.maximum(1 / (s**2 * precision), _LEAST_SHIFT * jnp.finfo(s.dtype).eps)


def largest_deviation(image: Image) -> Float[Array, ""]:
    """s of a first step."""
    return or_one(_FIRST * brightness(image))


def course(steps: int, begin: float = 1.0) -> list[float]:
    """s of the steps after the first, relative to its own."""
    return np.geomspace(begin, _LAST, steps).tolist()


@eqx.filter_jit
def largest_noise(
    normal: AbstractNormal, shift: Float[Array, ""], precision: Float[Array, ""]
) -> Float[Array, "channel 1"] | Float[Array, ""]:
    """The noise of z for a denoiser: the largest of a ring of frequencies, at least 0.4 s.

    s/2 where the modes are not frequencies, and of several planes, since each has the others'
    errors.
    """
    s = 1 / jnp.sqrt(shift * precision)
    planes = normal.problem.image_shape[-3]
    if planes > 1 or not isinstance(normal, IterativeNormal) or normal.powers is None:
        return s / 2
    inverse = dataclasses.replace(normal, shift=shift).inverse_filter()[:, 0].real
    power = (inverse - shift * inverse**2) / precision  # M⁻¹ AᵀwA M⁻¹ = M⁻¹ − μ M⁻²
    rows, columns = padded_field(normal.problem.field_shape)
    radius = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns))
    ring = np.ravel(radius / _RING).astype(int)
    sums = jnp.zeros((*power.shape[:2], ring.max() + 1), power.dtype)
    sums = sums.at[..., ring].add(power.reshape(*power.shape[:2], -1))
    means = sums / np.maximum(np.bincount(ring), 1).astype(power.dtype)  # small fields miss some
    return jnp.maximum(jnp.sqrt(jnp.max(means, axis=-1)), _LEAST_NOISE * s)


def _is_slow(problem: InverseProblem) -> bool:
    """Whether there are several planes, or as many unknowns as pixels."""
    pixels = sum(math.prod(c.shape[-2:]) for c in problem.captures)
    return problem.image_shape[-3] > 1 or math.prod(problem.image_shape[-2:]) >= pixels


def _split(image: Image, parts: list[InverseProblem]) -> list[Image]:
    return list(image.reshape(len(parts), *parts[0].image_shape))


def _normal(
    problem: InverseProblem, shift: Float[Array, ""], like: AbstractNormal | None
) -> AbstractNormal:
    """The normal equations; with the dense Gram matrix of another part of equal weights."""
    if isinstance(like, DenseNormal) and all(
        bool(jnp.array_equal(*pair))
        for pair in zip(problem.weights, like.problem.weights, strict=True)
    ):
        return eqx.tree_at(lambda normal: normal.problem, like, problem)
    return normal_equations(problem, shift)


@eqx.filter_jit
def data_step(
    normal: AbstractNormal,
    right: Image,
    image: Image,
    shift: Float[Array, ""],
    precision: Float[Array, ""],
) -> Image:
    """z; by conjugate gradients the change from f, up to a part of the noise of Aᵀg."""
    normal = normal.shifted(shift)
    if not isinstance(normal, IterativeNormal):
        return normal.solve(right + shift * image)
    shape, dtype = normal.problem.image_shape, normal.problem.captures[0].dtype
    signs = jax.random.rademacher(jax.random.key(0), shape, dtype)
    noise = jnp.sqrt(jnp.mean(signs * (normal.applied(signs) - shift * signs)) / precision)
    change = right + shift * image - normal.applied(image)
    size = or_one(jnp.sqrt(jnp.mean(change**2)))
    tolerance = jax.lax.stop_gradient(jnp.clip(_STEP_ERROR * noise / size, 1e-6, 0.1))

    def solved(_, right: Image) -> Image:
        return normal.solution(right, jnp.zeros_like(right), tolerance, INNER_STEPS).value

    return image + jax.lax.custom_linear_solve(normal.applied, change, solved, symmetric=True)


@jax.jit
def _judged(problem: InverseProblem, precision, before: Image, found: Image, image: Image):
    """Misfit, distance from the data step's image and change, relative to the image."""
    size = or_one(jnp.sqrt(jnp.sum(image**2)))
    gaps = [jnp.sqrt(jnp.sum((image - other) ** 2)) / size for other in (found, before)]
    return precision * jnp.sum(misfit(problem, image)), *gaps


def _parts(problem: InverseProblem) -> list[InverseProblem]:
    """A problem for each image and colour; colours that an operator takes together stay so."""
    if convolutions(problem) is not None:
        return independent_parts(problem)
    if any(len(o.in_shape) == 4 for o in problem.operators):
        return [problem]
    shapes = [(1, *detector_shape(o)) for o in problem.operators]
    captures, weights = list(problem.captures), list(problem.weights)
    count = captures[0].size // math.prod(shapes[0])
    for k, shape in enumerate(shapes):
        if weights[k].size > 1:
            whole_weight = jnp.broadcast_to(weights[k], captures[k].shape)
            weights[k] = whole_weight.reshape(count, *shape)
        else:
            weights[k] = jnp.broadcast_to(weights[k].reshape(()), (count,))
        captures[k] = captures[k].reshape(count, *shape)
    return [
        eqx.tree_at(
            lambda p: (p.captures, p.weights),
            problem,
            (tuple(c[i] for c in captures), tuple(w[i] for w in weights)),
        )
        for i in range(count)
    ]
