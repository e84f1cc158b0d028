"""Solvers for regularised least squares: by ADMM with total variation, and by FISTA."""

import abc
import dataclasses
import functools
import time
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.quantity import quantity, whole
from thincam_jax.imaging.operators import Matrix, ReducedMatrix
from thincam_jax.imaging.operators.low_rank import LowRank
from thincam_jax.reconstruction.choose_tau import SearchInterrupted, find_tau
from thincam_jax.reconstruction.coarse import coarsened, finer
from thincam_jax.reconstruction.cut_psf import with_cut_psfs
from thincam_jax.reconstruction.imaging_model import Cameras
from thincam_jax.reconstruction.iterate import CHUNK, Callback, Outcome, Schedule, iterate
from thincam_jax.reconstruction.other_psf import better_psf, negative_captures
from thincam_jax.reconstruction.outside_light import covering, reaching_beyond
from thincam_jax.reconstruction.parallel import in_parallel
from thincam_jax.reconstruction.planes import (
    with_equal_planes,
    with_smooth_light,
    without_smooth_misfit,
)
from thincam_jax.reconstruction.problem import InverseProblem, with_tau
from thincam_jax.reconstruction.proximal_gradient import solve_fista
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularisers import AbstractRegulariser, Image
from thincam_jax.reconstruction.result import Reconstruction, saying
from thincam_jax.reconstruction.smooth_misfit import misfit_of
from thincam_jax.reconstruction.solver import (
    DEFAULT_TAU,
    AbstractIterativeSolver,
    as_regulariser,
    as_synthesis,
    as_tau,
    as_tolerance,
    as_variation,
    first_image,
)
from thincam_jax.reconstruction.splittings import admm_method
from thincam_jax.reconstruction.total_variation import TotalVariation
from thincam_jax.reconstruction.uniform_light import begin_without

# Iterations during which penalties adapt. Later changes make the objective jump: on the captures of
# tests/reconstruction/test_admm.py ADMM then needs 1.4 to twice the iterations. Several planes are
# separated by the weak frequencies in which their PSFs differ: in half of all iterations, as fast
# as otherwise in four times as many.
_BALANCED = 30
# How often pixels are made twice as large, and the tolerance there: the image is only a start.
# From it an image ends that changes by less than this times the tolerance in ten iterations.
_COARSER, _ROUGH, _STILL = 2, 3e-3, 100.0
# Rise of the objective, relative, from which on penalties that suit an image lead away.
_RISEN = 1e-3
# Variation of an image whose smooth light counts less, in parts of the first one's, below which it
# is taken: 0.35 to 0.85 where shading had spoilt detail. That of a real hand is 1.0, with haze.
_CALMER = 0.92
# Share of the iterations that a biased camera spends without its uniform light.
_FIRST_PART = 0.4
# Tolerance below which the objective ends a run by its square.
_FINE = 1e-4
# Iterations after which an image that has not converged tells of misfit as well.
_SETTLED = 100


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
        recording = covering(recording, start)
        problem, outcome, unit = self._iterated(recording, start, callback)
        result = recording.reconstruction(_over(outcome, unit), self.name, float(problem.tau))
        result = saying(result, outcome.reason)
        if not _is_settled(outcome):
            return result
        solve = functools.partial(self.solve, start=start, callback=callback)
        return reaching_beyond(solve, recording, problem, outcome.image, result, self.synthesis)

    def whole_field(
        self, recording: Recording, start: Float[Array, "..."] | None = None
    ) -> Outcome:
        """The outcome with the image of the whole field, not only of the part that is shown."""
        _, outcome, unit = self._iterated(recording, start, None)
        return _over(outcome, unit)

    def _iterated(
        self, recording: Recording, start: Float[Array, "..."] | None, callback: Callback | None
    ) -> tuple[InverseProblem, Outcome, Float[Array, "plane 1 1"] | None]:
        """The problem, its outcome, and the unit by which planes are divided, if there is one."""
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
        whole, unit = with_equal_planes(problem)
        image = first_image(whole, upright, uniform=uniform)
        problem = whole if unit is None else without_smooth_misfit(whole)
        is_filtered = problem is not whole
        if unit is not None and upright is not None:
            image = image * unit
        if self.nonnegative:  # it is returned if no iterate is better
            image = jnp.asarray(np.maximum(np.asarray(image), 0))
        if rule:
            try:
                found = find_tau(rule, problem, image)
            except SearchInterrupted as end:
                seconds = time.perf_counter() - began
                return problem, Outcome(end.image, "interrupted", (), 0, seconds), unit
            # From the same start as a solver with this τ, and so to the same image.
            problem, reason = found.problem, found.reason
        outcome = self.minimise(problem, image, callback, given=start is not None)
        if is_filtered and _is_settled(outcome, _SETTLED + 1):
            whole = with_tau(whole, problem.tau)

            def minimise(image, iterations):
                shorter = dataclasses.replace(self, iterations=iterations)
                return shorter.minimise(whole, image, callback, given=True)

            outcome = with_smooth_light(whole, outcome, minimise, self.iterations)
        if rule:
            outcome = dataclasses.replace(outcome, seconds=time.perf_counter() - began)
            outcome = saying(outcome, reason, outcome.reason)
        return problem, outcome, unit


def _over(outcome: Outcome, unit: Float[Array, "plane 1 1"] | None) -> Outcome:
    return outcome if unit is None else dataclasses.replace(outcome, image=outcome.image / unit)


def _is_settled(outcome: Outcome, least: int = _SETTLED) -> bool:
    """Whether what an image leaves is misfit, not what more iterations would explain."""
    done = outcome.status == "iterations_exhausted" and outcome.iterations >= least
    return done or outcome.status == "converged"


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
    - `iterations`: at most. `tolerance`: relative residuals at which they end. So does, from an
      image on larger pixels, a change of the image over ten iterations by 100 times as much, 1 %;
      else one of the objective over 20 by a tenth of a percent, of less as the square of less.

    **Errors**: ValueError, one line, for values out of range.

    ```python
    import numpy as np
    import thincam_jax as tc

    psf = np.random.default_rng(0).random((9, 9))
    recording = tc.Recording(np.ones((1, 24, 32)), tc.Psfs(psf[None]))
    result = tc.reconstruct(recording, tc.AdmmTV(tau=2.0, iterations=10))
    ```

    **See also**: `reconstruct`, `reconstruction.TotalVariation`, `Fista`.
    """

    name: ClassVar[str] = "admm_tv"
    iterations: int = eqx.field(default=300, converter=whole(1), static=True, kw_only=True)
    variation: TotalVariation = eqx.field(default=None, converter=as_variation, kw_only=True)

    @property
    def prior(self):
        return self.variation

    def minimise(
        self, problem: InverseProblem, image: Image, callback: Callback | None, *, given: bool
    ):
        """Minimise by ADMM; without an image given first on coarser pixels.

        If it converged and leaves smooth light unexplained, once more with less weight on that;
        the outcome says so, and is the one if its image varies less.
        """
        if given:
            return self._by_admm(problem, image, callback)
        outcome = self._by_levels(problem, image, callback)
        if outcome.reason:
            return outcome
        misfit = misfit_of(problem, outcome.image) if _is_settled(outcome) else None
        if misfit is None:
            return outcome
        if misfit.is_suspect:
            better = better_psf(problem, image, self.lowest_objective, not misfit.is_smooth)
            if better:
                return dataclasses.replace(outcome, reason=better)
        if outcome.status != "converged":  # what is left is not yet misfit
            return outcome
        easier, said = misfit.less_smooth(problem), str(misfit)
        if easier is not None:
            again = self._by_levels(easier, image, callback)
            seconds = outcome.seconds + again.seconds
            before, after = (float(jnp.sum(problem.regulariser(o.image))) for o in (outcome, again))
            if after < _CALMER * before:
                outcome, said = again, f"{said}, so smooth light counts less"
            elif again.status in ("stopped", "interrupted"):
                outcome = dataclasses.replace(outcome, status=again.status)
            outcome = dataclasses.replace(outcome, seconds=seconds)
        return dataclasses.replace(outcome, reason=said)

    def lowest_objective(self, problem: InverseProblem, image: Image) -> float:
        """The lowest objective, roughly, from a start image."""
        return float(self._rough._from_nothing(problem, image, None).history[-1].objective)

    @property
    def _rough(self) -> "AdmmTV":
        """This solver with the tolerance of a start."""
        return dataclasses.replace(self, tolerance=max(self.tolerance, _ROUGH))

    def _by_levels(self, problem, image, callback) -> Outcome:
        """Outcome by way of larger pixels, if there are enough."""
        coarse, small, size = coarsened(with_cut_psfs(problem, image), image, _COARSER)
        if size == 1:
            outcome = self._from_nothing(problem, image, callback)
            said = self._negative(problem, problem, image, outcome)
            return dataclasses.replace(outcome, reason=said)
        first = self._rough._from_nothing(coarse, small, None, rough=True)
        image = finer(first.image, problem.field_shape)
        if first.status in ("interrupted", "non_finite"):
            return dataclasses.replace(first, image=image)
        # Penalties are those of the image, and stay: unless they lead away, as from smooth misfit.
        still = _STILL * self.tolerance
        schedule = Schedule(self.iterations, self.tolerance, still=still, rising=_RISEN)
        method = in_parallel(with_cut_psfs(problem, image), admm_method, image)
        second = iterate(method, image, schedule, callback=callback)
        if second.status == "iterations_exhausted" and second.iterations < self.iterations:
            third = self._by_admm(problem, second.image, callback, second.iterations)
            second = second.followed_by(third)
        is_over = second.status in ("stopped", "interrupted", "non_finite")
        said = "" if is_over else self._negative(problem, coarse, small, first)
        return dataclasses.replace(second, seconds=first.seconds + second.seconds, reason=said)

    def _negative(self, problem: InverseProblem, coarse, image: Image, outcome: Outcome) -> str:
        """A sentence where inverted captures fit far better; see `negative_captures`."""
        start = functools.partial(self._rough._from_nothing, callback=None, rough=True)
        finish = functools.partial(self._by_admm, callback=None)
        return negative_captures(problem, coarse, image, outcome, start, finish)

    def _from_nothing(self, problem, image, callback, *, rough: bool = False) -> Outcome:
        """Outcome from a uniform or black image; a biased camera's begins without uniform light.

        - `rough`: see `splitting_of`.
        """
        lit = bool(np.any(np.asarray(image)))
        # Whole chunks between two checks: a callback sees every tenth iteration throughout.
        count = CHUNK * round(_FIRST_PART * self.iterations / CHUNK)
        begin = Schedule(count, self.tolerance, adapt_until=min(_BALANCED, count // 2))
        first = begin_without(problem, image, begin, callback) if lit and count else None
        if first is None:
            return self._by_admm(problem, image, callback, rough=rough)
        if first.status in ("stopped", "interrupted", "non_finite"):
            return first
        try:
            second = self._by_admm(problem, first.image, callback, first.iterations, rough=rough)
        except KeyboardInterrupt:  # before its iterations, which keep their own best image
            return dataclasses.replace(first, status="interrupted")
        return first.followed_by(second)

    def _by_admm(self, problem, image, callback, done: int = 0, *, rough: bool = False) -> Outcome:
        """Outcome from any image."""
        half, planes = (self.iterations - done) // 2, problem.image_shape[-3]
        until = done + (min(_BALANCED, half) if planes == 1 else half)
        limits = self.iterations, self.tolerance
        # About its minimum the objective changes by the square of the image's change.
        settled = 10 * self.tolerance * min(1.0, self.tolerance / _FINE)
        # Of a start only the objective tells its end: residuals take a third of small iterations.
        ends = {"settled": settled, "judged": not rough}
        schedule = Schedule(*limits, adapt_until=until, done=done, **ends)
        method = in_parallel(problem, functools.partial(admm_method, rough=rough))
        return iterate(method, image, schedule, callback=callback)


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

    **See also**: `AdmmTV`, `reconstruction.implicit_gradient.implicit_proximal_gradient`.
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
