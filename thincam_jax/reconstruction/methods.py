"""`reconstruct`, the solvers for regularised least squares, and the choice of a solver."""

import abc
import dataclasses
import functools
import time
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.quantity import quantity, whole
from thincam_jax.imaging.operators import LowRank, Matrix, ReducedMatrix
from thincam_jax.imaging.operators.crop_convolution import CropConvolution, cut, place
from thincam_jax.reconstruction.choose_tau import SearchInterrupted, find_tau
from thincam_jax.reconstruction.fringe_filter import FringeScanning
from thincam_jax.reconstruction.imaging_model import Cameras
from thincam_jax.reconstruction.iterate import CHUNK, Callback, Outcome, Schedule, iterate
from thincam_jax.reconstruction.parallel import in_parallel
from thincam_jax.reconstruction.planes import with_equal_planes
from thincam_jax.reconstruction.poisson import PoissonTV
from thincam_jax.reconstruction.problem import (
    InverseProblem,
    compiled_objective,
    convolutions,
    or_one,
    residuals,
    uniform_level,
)
from thincam_jax.reconstruction.proximal_gradient import solve_fista
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularisers import AbstractRegulariser, Image
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.reconstruction.ridge import Ridge
from thincam_jax.reconstruction.solver import (
    DEFAULT_TAU,
    AbstractIterativeSolver,
    AbstractSolver,
    Synthesis,
    as_regulariser,
    as_synthesis,
    as_tau,
    as_tolerance,
    as_variation,
    first_image,
)
from thincam_jax.reconstruction.splittings import admm_method
from thincam_jax.reconstruction.total_variation import TotalVariation
from thincam_jax.reconstruction.wiener import Wiener, filter_suffices

# Iterations during which penalties adapt. Later changes make the objective jump: on the captures of
# tests/reconstruction/test_admm.py ADMM then needs 1.4 to twice the iterations. Several planes are
# separated by the weak frequencies in which their PSFs differ: in half of all iterations, as fast
# as otherwise in four times as many.
_BALANCED = 30
# Share of the iterations that a biased camera spends without its uniform light.
_FIRST_PART = 0.4
# A camera is biased if its response at zero frequency is this many times the root mean square of
# all: for a zone aperture 0.7 times its width in pixels, almost nothing where the background
# cancels. At 30 dB this start harms or changes nothing up to 100, and gains from 190 on.
_BIASED = 150.0

# Shorter side of the sensor over the side of the high-pass window, and the smallest window.
_PART, _SMALLEST = 8, 5

# Least share of the valid pixels that must remain.
_LEAST_SHARE = 0.25


@checked
def reconstruct(
    recording: Recording,
    solver: AbstractSolver | None = None,
    *,
    start: Float[Array, "..."] | None = None,
    callback: Callback | None = None,
) -> Reconstruction:
    """Reconstruct the image of a scene from captures of it.

    **Arguments**

    - `recording`: captures with their imaging model and noise, see `Recording`.
    - `solver`: the method with its settings: `Wiener`, `FringeScanning` (filters, for `Cameras`),
      `AdmmTV`, `Fista`, `Ridge` or `PoissonTV`. Default: the one of `choose_solver`; the result
      has its reason.
    - `start`: a start image, such as an earlier result. By default it is uniform with cameras,
      matrices and `LowRank` operators and for `PoissonTV`, else black. With a start image `AdmmTV`
      omits its first part without the uniform light, see docs/guide/reconstruct.md.
    - `callback`: called with `Progress` every tenth iteration of `AdmmTV` and `Fista`; it stops
      the run by returning a true value. Ctrl-C returns the best image so far, with the status
      "interrupted".

    Images of a batch are reconstructed together. To filter many recordings call `prepare` of the
    filter once. Under jit, grad or vmap use `solve_fixed_point`.

    **Errors**: ValueError and TypeError, one line, for a recording, start or callback that the
    solver cannot use.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    scene = tc.Scene(tc.ImagePlane([[0.0, 1.0]], distance=250.0, width=40.0), 500 * nm)
    optics = tc.Cameras([camera], wavelength=500 * nm, object_distance=250.0)
    recording = tc.Recording([tc.capture(camera, scene)], optics)
    result = tc.reconstruct(recording, tc.AdmmTV(tau=2.0, iterations=10))
    ```

    **See also**: `Recording`, `AdmmTV`, `Wiener`, `choose_solver`.
    """
    reason = ""
    if solver is None:
        solver, reason = choose_solver(recording)
    if isinstance(solver, AbstractIterativeSolver):
        if any(checks.is_traced(capture) for capture in recording.captures):
            raise TypeError(
                f"{type(solver).__name__} checks its convergence between iterations: call it "
                "outside of jit, grad and vmap, or use tc.solve_fixed_point there"
            )
        result = solver.solve(recording, start=start, callback=callback)
    elif start is not None or callback is not None:
        raise ValueError(f"{type(solver).__name__} runs in one piece; leave out start and callback")
    else:
        result = solver.solve(recording)
    return dataclasses.replace(result, reason=reason) if reason else result


@checked
def choose_solver(
    recording: Recording, synthesis: Synthesis | None = None
) -> tuple[AbstractSolver, str]:
    """Choose `Wiener`, `AdmmTV` or `Fista`, and give the reason in a sentence.

    The fast filter is chosen where it is as good, see `filter_suffices`; `Fista` for `LowRank`
    operators, of which each iteration of ADMM takes some 80 applications. `PlugAndPlay` gained with
    every camera measured and is named, but not chosen: what it has not learned, such as text, it
    may do worse.

    - `synthesis`: sums of captures for the solver; see `AdmmTV`.

    ```python
    import numpy as np
    import thincam_jax as tc

    psf = np.random.default_rng(0).random((9, 9))
    recording = tc.Recording(np.ones((1, 24, 32)), tc.Psfs(psf[None]))
    solver, reason = tc.choose_solver(recording)
    print(solver.name)  # admm_tv
    ```

    **See also**: `reconstruct`.
    """
    operators = getattr(recording.imaging_model, "operators", ())
    over_field = getattr(recording.imaging_model, "over_field", False)
    if synthesis is None and (over_field or any(isinstance(one, LowRank) for one in operators)):
        return Fista(), "a sum of many convolutions is applied once an iteration, ADMM solves it"
    suffices, reason = filter_suffices(recording, synthesis)
    if not suffices:
        reason += "; of photographs PlugAndPlay makes images 0.2 to 2 dB better"
    return (Wiener if suffices else AdmmTV)(synthesis=synthesis), reason


def starts_uniform(recording: Recording, problem: InverseProblem) -> bool:
    """Whether the scene fills the field, so that a uniform image is nearer to it than darkness."""
    bright = all(isinstance(o, Matrix | ReducedMatrix | LowRank) for o in problem.operators)
    return bright or isinstance(recording.imaging_model, Cameras)


class AbstractRegularised(AbstractIterativeSolver):
    """A solver that minimises ½ Σ w (Af − g)² + τ R(f), with R its `prior`."""

    tau: Float[Array, ""] | str = eqx.field(default=DEFAULT_TAU, converter=quantity(check=as_tau))
    nonnegative: bool = eqx.field(default=True, converter=bool, static=True, kw_only=True)
    synthesis: np.ndarray | None = eqx.field(default=None, converter=as_synthesis, kw_only=True)
    iterations: int = eqx.field(default=100, converter=whole(1), static=True, kw_only=True)
    tolerance: float = eqx.field(default=1e-4, converter=as_tolerance, static=True, kw_only=True)

    @property
    @abc.abstractmethod
    def prior(self) -> AbstractRegulariser:
        """R."""

    @abc.abstractmethod
    def minimise(
        self, problem: InverseProblem, image: Image, callback: Callback | None, *, given: bool
    ) -> Outcome:
        """Minimise a problem from a start image, which the user may have given."""

    def solve(
        self,
        recording: Recording,
        *,
        start: Float[Array, "..."] | None = None,
        callback: Callback | None = None,
    ) -> Reconstruction:
        """Reconstruct from the start image; by default uniform or zero, as `reconstruct` says.

        A uniform image explains the bright background of a zone aperture's capture, or of a screen
        that scatters, at once, which would otherwise take up to hundreds of iterations; a mostly
        dark field is nearer to zero.
        """
        rule, reason = (self.tau if isinstance(self.tau, str) else None), ""
        problem = recording.problem(
            tau=DEFAULT_TAU if rule else self.tau,
            regulariser=self.prior,
            nonnegative=self.nonnegative,
            synthesis=self.synthesis,
        )
        began = time.perf_counter()
        uniform = starts_uniform(recording, problem)
        upright = None if start is None else recording.oriented(start)
        problem, unit = with_equal_planes(problem)
        image = first_image(problem, upright, uniform=uniform)
        if unit is not None and upright is not None:
            image = image * unit
        if self.nonnegative:  # it is returned if no iterate is better
            image = jnp.maximum(image, 0)
        given = start is not None or not uniform
        if rule:
            try:
                found = find_tau(rule, problem, image)
            except SearchInterrupted as end:
                seconds = time.perf_counter() - began
                image = end.image if unit is None else end.image / unit
                outcome = Outcome(image, "interrupted", (), 0, seconds)
                return recording.reconstruction(outcome, self.name, float(problem.tau))
            # From the same start as a solver with this τ, and so to the same image.
            problem, reason = found.problem, found.reason
        outcome = self.minimise(problem, image, callback, given=given)
        if unit is not None:
            outcome = dataclasses.replace(outcome, image=outcome.image / unit)
        if rule:
            outcome = dataclasses.replace(outcome, seconds=time.perf_counter() - began)
        result = recording.reconstruction(outcome, self.name, float(problem.tau))
        return dataclasses.replace(result, reason=reason) if reason else result


class AdmmTV(AbstractRegularised):
    """Least squares with total variation by ADMM, with the crop of the sensor in the model.

    Convolutions are diagonalised by Fourier transforms, a separable or dense operator is
    factorised once, any other takes conjugate gradients in each iteration.

    **Arguments**

    - `tau`: weight of the variation relative to the noise, about 1 to 3; see `InverseProblem`.
      "discrepancy" (up to 5 times the time) or "sure" (some 20 times) choose it between 0.8 and 4
      times the default, or above if the residual shows that the PSF is wrong; see
      `choose_tau.find_tau`.
    - `variation`: its kind and the coupling of colours, see `TotalVariation`.
    - `nonnegative`: whether to constrain f ≥ 0.
    - `synthesis`: sums of captures in place of the captures, see
      `thincam_jax.reconstruction.synthesis`; for `Cameras` only.
    - `iterations`: at most. `tolerance`: of the relative residuals.

    **Errors**: ValueError, one line, for values out of range.

    ```python
    import numpy as np
    import thincam_jax as tc

    psf = np.random.default_rng(0).random((9, 9))
    recording = tc.Recording(np.ones((1, 24, 32)), tc.Psfs(psf[None]))
    result = tc.reconstruct(recording, tc.AdmmTV(tau=2.0, iterations=10))
    ```

    **See also**: `reconstruct`, `TotalVariation`, `Fista`.
    """

    name: ClassVar[str] = "admm_tv"
    variation: TotalVariation = eqx.field(default=None, converter=as_variation, kw_only=True)

    @property
    def prior(self):
        return self.variation

    def minimise(
        self, problem: InverseProblem, image: Image, callback: Callback | None, *, given: bool
    ):
        """Minimise by ADMM; a biased camera begins without its uniform light."""
        first = None if given else self._without_uniform_light(problem, image, callback)
        if first is None:
            return self._by_admm(problem, image, callback)
        if first.status in ("stopped", "interrupted", "non_finite"):
            return first
        try:
            second = self._by_admm(problem, first.image, callback, first.iterations)
        except KeyboardInterrupt:  # before its iterations, which keep their own best image
            return dataclasses.replace(first, status="interrupted")
        return dataclasses.replace(
            second,
            history=first.history + second.history[1:],
            seconds=first.seconds + second.seconds,
        )

    def _by_admm(self, problem, image, callback, done: int = 0) -> Outcome:
        half, planes = (self.iterations - done) // 2, problem.image_shape[-3]
        until = done + (min(_BALANCED, half) if planes == 1 else half)
        schedule = Schedule(self.iterations, self.tolerance, adapt_until=until, done=done)
        return iterate(in_parallel(problem, admm_method), image, schedule, callback=callback)

    def _without_uniform_light(self, problem, image, callback) -> Outcome | None:
        """The first part of the iterations; None for an unbiased camera or too few iterations.

        Whole chunks between two checks, so that a callback sees every tenth iteration throughout.
        """
        count = CHUNK * round(_FIRST_PART * self.iterations / CHUNK)
        easier = without_uniform_light(problem) if count else None
        if easier is None:
            return None
        outcome = iterate(
            in_parallel(easier, admm_method),
            image,
            Schedule(count, self.tolerance, adapt_until=min(_BALANCED, count // 2)),
            callback=callback,
            objective=functools.partial(objective_with_uniform_light, problem),
        )
        return dataclasses.replace(outcome, image=with_uniform_light(problem, outcome.image))


class Fista(AbstractRegularised):
    """Least squares with any regulariser by accelerated proximal gradients.

    Operators need A and Aᵀ only, and there are no penalties. With total variation the minimiser
    is that of `AdmmTV`, after more iterations.

    **Arguments**: as of `AdmmTV`, and

    - `regulariser`: R, such as `TotalVariation`, the default, or `Sparsity` in wavelets or cosines,
      with the same τ: a coefficient of an orthonormal basis has the noise of a pixel.

    ```python
    import numpy as np
    import thincam_jax as tc

    psf = np.random.default_rng(0).random((9, 9))
    recording = tc.Recording(np.ones((1, 24, 32)), tc.Psfs(psf[None]))
    result = tc.reconstruct(recording, tc.Fista(tau=2.0, iterations=10))
    ```

    **See also**: `AdmmTV`, `implicit_proximal_gradient`.
    """

    name: ClassVar[str] = "fista"
    regulariser: AbstractRegulariser = eqx.field(
        default=None, converter=as_regulariser, kw_only=True
    )

    def __check_init__(self):
        if isinstance(self.tau, str) and not isinstance(self.regulariser, TotalVariation):
            raise ValueError(
                f"tau = {self.tau!r} is for total variation only; give a number, about 1 to 3"
            )

    @property
    def prior(self):
        return self.regulariser

    def minimise(
        self, problem: InverseProblem, image: Image, callback: Callback | None, *, given: bool
    ):
        """Minimise by FISTA with restart."""
        return solve_fista(
            problem,
            image=image,
            iterations=self.iterations,
            tolerance=self.tolerance,
            callback=callback,
        )


# The words of experiment files and commands, `method: admm_tv`.
SOLVERS: dict[str, type[AbstractSolver]] = {
    solver.name: solver for solver in (Wiener, FringeScanning, AdmmTV, Fista, Ridge, PoissonTV)
}


def without_uniform_light(problem: InverseProblem) -> InverseProblem | None:
    r"""The problem with biased cameras high-passed; None without any, or if few pixels remain.

    A zone aperture passes a good part of the light uniformly. The zero frequency of its response is
    then hundreds of times as strong as the others, and an iteration that must fit it moves the
    others little. A high-pass p removes the uniform light exactly, and commutes with the camera:
    with g = C(h ∗ f), C the crop to the sensor,

    .. math:: p * g = C'\big((p * h) * f\big), \qquad p = \delta - w,\quad \sum w = 1

    on the pixels C′ whose window w lies on the sensor. Only the noise is approximated: at the
    lowest frequencies it is weaker than assumed. The mean brightness and the outermost pixels are
    lost, so the image found is the start image for the problem with all data.

    The captures keep their shape: pixels near the border, or near an invalid one, have weight 0.
    """
    operators = convolutions(problem)
    if operators is None:
        return None
    rows = tuple(bool(bias > _BIASED) for bias in jax.device_get(_biases(operators)))
    shortest = min(min(c.shape[-2:]) for c in problem.captures)
    length = 2 * (shortest // (2 * _PART)) + 1
    if not any(rows) or length < _SMALLEST:
        return None
    weights, captures = list(problem.weights), list(problem.captures)
    for index, row in enumerate(rows):
        if row:
            weight, capture = weights[index], captures[index]
            shape = jnp.broadcast_shapes(weight.shape, capture.shape[-2:])
            valid = np.broadcast_to(np.asarray(weight) > 0, shape)
            whole = full_windows(valid, length)
            if whole.sum() < _LEAST_SHARE * valid.sum():
                return None
            weights[index] = weight * jnp.asarray(whole, weight.dtype)
            # Invalid pixels may be huge, and rounding would spread them over the sensor.
            captures[index] = jnp.where(weight > 0, capture, 0)
    problem = eqx.tree_at(
        lambda p: (p.weights, p.captures), problem, (tuple(weights), tuple(captures))
    )
    return _high_passed(problem, rows, length)


def full_windows(
    valid: Bool[np.ndarray, "*batch y x"], length: int
) -> Bool[np.ndarray, "*batch y x"]:
    """Pixels whose whole window, `length` on a side, is on the sensor and valid."""
    margin = length // 2
    whole = np.pad(valid, [(0, 0)] * (valid.ndim - 2) + [(margin, margin)] * 2)
    for axis in (-2, -1):
        whole = np.min(np.lib.stride_tricks.sliding_window_view(whole, length, axis=axis), axis=-1)
    return whole


@jax.jit
def with_uniform_light(problem: InverseProblem, image: Image) -> Image:
    """The image plus the uniform light that explains the captures best, f ≥ 0 if constrained."""
    missing = tuple(-r for r in residuals(problem, image))
    level = uniform_level(eqx.tree_at(lambda p: p.captures, problem, missing))
    image = image + level[..., None, None, None]
    return jnp.maximum(image, 0) if problem.nonnegative else image


def objective_with_uniform_light(problem: InverseProblem, image: Image) -> Float[Array, "*batch"]:
    """Objective of an image after adding the uniform light."""
    return compiled_objective(problem, with_uniform_light(problem, image))


@jax.jit
def _biases(operators: tuple[CropConvolution, ...]) -> list[Float[Array, ""]]:
    uniform = [jnp.max(jnp.abs(o.spectrum[..., 0, 0])) for o in operators]
    return [u / jnp.sqrt(or_one(o.mean_power())) for u, o in zip(uniform, operators, strict=True)]


@eqx.filter_jit
def _high_passed(problem: InverseProblem, rows: tuple[bool, ...], length: int):
    """High-pass the spectra and captures of the given rows."""
    operators, captures = list(convolutions(problem) or ()), list(problem.captures)
    window = operators[0].window
    transfer = jnp.asarray(1 - _window_transfer(length, window), problem.captures[0].dtype)

    def filtered(capture, corner):
        spectrum = jnp.fft.rfft2(place(capture, corner, window))
        whole = jnp.fft.irfft2(spectrum * transfer.astype(spectrum.dtype), s=window)
        return cut(whole, corner, capture.shape[-2:])

    for index, row in enumerate(rows):
        if row:
            operator = operators[index]
            spectrum = operator.spectrum * transfer.astype(operator.spectrum.dtype)
            operators[index] = eqx.tree_at(lambda o: o.spectrum, operator, spectrum)
            captures[index] = filtered(captures[index], operator.sensor_corner)
    return eqx.tree_at(
        lambda p: (p.operators, p.captures), problem, (tuple(operators), tuple(captures))
    )


def _window_transfer(length: int, window: tuple[int, int]) -> np.ndarray:
    """Transfer function of a Hann window of sum 1 in both directions, centred: real."""
    hann = np.hanning(length + 2)[1:-1]
    places = np.arange(length) - length // 2

    def along(frequencies):
        return np.cos(2 * np.pi * np.outer(frequencies, places)) @ hann / hann.sum()

    return np.outer(along(np.fft.fftfreq(window[0])), along(np.fft.rfftfreq(window[1])))
