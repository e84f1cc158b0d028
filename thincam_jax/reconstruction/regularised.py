"""Total variation or another regulariser: what its solvers have in common, and the solvers."""

import abc
import dataclasses
import functools
import math
import time
from typing import Any, ClassVar, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax.imaging.operators.crop_convolution import place
from thincam_jax.reconstruction.admm import AdmmMethod
from thincam_jax.reconstruction.apart import Apart, worth_taking_apart
from thincam_jax.reconstruction.choose_tau import SearchInterrupted, find_tau
from thincam_jax.reconstruction.drive import CHUNK, AbstractMethod, Callback, Outcome, drive
from thincam_jax.reconstruction.fista import solve_fista
from thincam_jax.reconstruction.high_pass import high_passed, levelled, levelled_objective
from thincam_jax.reconstruction.problem import InverseProblem, uniform_level
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularisers import AbstractRegulariser, Image
from thincam_jax.reconstruction.seen_by import Cameras
from thincam_jax.reconstruction.solver import (
    AbstractIterativeSolver,
    Reconstruction,
    as_synthesis,
    at_most,
    small_enough,
)
from thincam_jax.reconstruction.total_variation import TotalVariation

TauRule = Literal["discrepancy", "sure"]
DEFAULT_TAU = 2.0

# Penalties that go on changing make the objective jump: on the captures of tests/reconstruction/
# test_admm.py ADMM then needs 1.4 to twice the iterations.
_BALANCED = 30
# Of the iterations for a biased camera, those without its uniform light.
_FIRST_PART = 0.4


class Start(eqx.Module):
    """A first image, and whether the user gave it."""

    image: Image
    given: bool


def checked_tau(tau: Any) -> Any:
    """τ ≥ 0, or the name of a rule that finds it."""
    if isinstance(tau, str):
        checks.choice("tau", tau, get_args(TauRule))
        return tau
    return checks.non_negative("tau", tau, "a ratio")


def of_kind(name: str, value: Any, kind: type):
    """A value of the kind that is asked for; by default one as the kind makes it."""
    if value is None:
        return kind()
    if not isinstance(value, kind):
        wanted = kind.__name__.removeprefix("Abstract")
        raise ValueError(f"{name} is a {type(value).__name__}; give a {wanted}")
    return value


as_variation = functools.partial(of_kind, "variation", kind=TotalVariation)


def as_regulariser(value: Any) -> AbstractRegulariser:
    """The regulariser given; total variation by default."""
    return TotalVariation() if value is None else of_kind("regulariser", value, AbstractRegulariser)


class AbstractRegularised(AbstractIterativeSolver):
    """A solver that minimises ½ Σ w (Af − g)² + τ R(f)."""

    tau: Float[Array, ""] | str = eqx.field(default=DEFAULT_TAU, converter=checked_tau)
    nonnegative: bool = eqx.field(default=True, converter=bool, static=True, kw_only=True)
    synthesis: np.ndarray | None = eqx.field(default=None, converter=as_synthesis, kw_only=True)
    iterations: int = eqx.field(default=100, converter=at_most, static=True, kw_only=True)
    tolerance: float = eqx.field(default=1e-4, converter=small_enough, static=True, kw_only=True)

    @property
    @abc.abstractmethod
    def prior(self) -> AbstractRegulariser:
        """R."""

    @abc.abstractmethod
    def minimise(self, problem: InverseProblem, start: Start, callback: Callback | None) -> Outcome:
        """The minimiser of a problem."""

    def solve(
        self,
        recording: Recording,
        *,
        start: Float[Array, "..."] | None = None,
        callback: Callback | None = None,
    ) -> Reconstruction:
        """The image of a recording, from the image given, a uniform one, or zero.

        A uniform image explains the bright background of a zone aperture's capture at once, which
        would else take hundreds of iterations; a field that is mostly dark is nearer to zero.
        """
        rule, reason = (self.tau if isinstance(self.tau, str) else None), ""
        problem = recording.problem(
            tau=DEFAULT_TAU if rule else self.tau,
            regulariser=self.prior,
            nonnegative=self.nonnegative,
            synthesis=self.synthesis,
        )
        began = time.perf_counter()
        uniform = isinstance(recording.seen_by, Cameras)
        upright = None if start is None else recording.oriented(start)
        image = first_image(problem, upright, uniform=uniform)
        if self.nonnegative:  # the best image so far may be this one
            image = jnp.maximum(image, 0)
        given = start is not None or not uniform
        if rule:
            try:
                found = find_tau(rule, problem, image)
            except SearchInterrupted as end:
                seconds = time.perf_counter() - began
                outcome = Outcome(end.image, "interrupted", (), 0, seconds)
                return recording.reconstruction(problem, outcome, self.name, float(problem.tau))
            # From the same start: the image is that of a solver with this τ.
            problem, reason = found.problem, found.reason
        outcome = self.minimise(problem, Start(image, given), callback)
        if rule:
            outcome = dataclasses.replace(outcome, seconds=time.perf_counter() - began)
        result = recording.reconstruction(problem, outcome, self.name, float(problem.tau))
        return dataclasses.replace(result, reason=reason) if reason else result


class AdmmTV(AbstractRegularised):
    """Least squares with total variation by ADMM, which knows that the sensor crops.

    For convolutions it transforms, for a separable or dense operator it factorises once, for any
    other each iteration solves a linear system by conjugate gradients.

    **Arguments**

    - `tau`: weight of the variation relative to the noise, about 1 to 3; see `InverseProblem`.
      "discrepancy" (up to 5 times the time) or "sure" (some 20 times) find it between 0.8 and 4
      times the default, or above where the residual says that the PSF is wrong; see
      `choose_tau.find_tau`.
    - `variation`: its kind and the coupling of colours, see `TotalVariation`.
    - `nonnegative`: ask for f ≥ 0.
    - `synthesis`: sums of captures in place of the captures, see
      `thincam_jax.reconstruction.synthesis`; for `Cameras` only.
    - `iterations`: at most. `tolerance`: on the relative residuals.

    **Errors**: ValueError, one line, for values out of range.
    """

    name: ClassVar[str] = "admm_tv"
    variation: TotalVariation = eqx.field(default=None, converter=as_variation, kw_only=True)

    @property
    def prior(self):
        return self.variation

    def minimise(self, problem: InverseProblem, start: Start, callback: Callback | None):
        """In two parts for a biased camera: first without the uniform light, then with all."""
        first = None if start.given else self._without_uniform_light(problem, start.image, callback)
        if first is None:
            return self._by_admm(problem, start.image, callback)
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
        return drive(
            admm_method(problem),
            image,
            iterations=self.iterations,
            tolerance=self.tolerance,
            adapt_until=done + min(_BALANCED, (self.iterations - done) // 2),
            callback=callback,
            done=done,
        )

    def _without_uniform_light(self, problem, image, callback) -> Outcome | None:
        """The first part of the iterations, levelled; None if the camera or their number asks none.

        Whole chunks between two looks, so that a callback sees every tenth iteration throughout.
        """
        count = CHUNK * round(_FIRST_PART * self.iterations / CHUNK)
        easier = high_passed(problem) if count else None
        if easier is None:
            return None
        outcome = drive(
            admm_method(easier),
            image,
            objective=functools.partial(levelled_objective, problem),
            iterations=count,
            tolerance=self.tolerance,
            adapt_until=min(_BALANCED, count // 2),
            callback=callback,
        )
        return dataclasses.replace(outcome, image=levelled(problem, outcome.image))


class Fista(AbstractRegularised):
    """The minimiser of `AdmmTV` by proximal gradients, with any regulariser.

    Nothing but applications of A and Aᵀ is asked of the operators. There are no penalties to
    choose, and more iterations to do.

    **Arguments**: as of `AdmmTV`, and

    - `regulariser`: R, such as `TotalVariation`, the default, or `Sparsity` in wavelets or cosines,
      with the same τ: a coefficient of an orthonormal basis has the noise of a pixel.
    """

    name: ClassVar[str] = "fista"
    regulariser: AbstractRegulariser = eqx.field(
        default=None, converter=as_regulariser, kw_only=True
    )

    def __check_init__(self):
        if isinstance(self.tau, str) and not isinstance(self.regulariser, TotalVariation):
            raise ValueError(
                f"tau = {self.tau!r} is found for total variation only; give a number, about 1 to 3"
            )

    @property
    def prior(self):
        return self.regulariser

    def minimise(self, problem: InverseProblem, start: Start, callback: Callback | None):
        """By FISTA with restart."""
        return solve_fista(
            problem,
            image=start.image,
            iterations=self.iterations,
            tolerance=self.tolerance,
            callback=callback,
        )


def admm_method(problem: InverseProblem) -> AbstractMethod:
    """ADMM for a problem, or for each of its parts."""
    return Apart(problem, AdmmMethod) if worth_taking_apart(problem) else AdmmMethod(problem)


def first_image(
    problem: InverseProblem, start: Float[Array, "..."] | None, *, uniform: bool
) -> Image:
    """The start given, amid zeros where it is smaller than the field; else uniform, or zero."""
    shape, dtype = problem.image_shape, problem.captures[0].dtype
    if start is None:
        level = _level(problem)[..., None, None, None] if uniform else jnp.zeros((), dtype)
        return jnp.broadcast_to(level, shape)
    start = jnp.asarray(start, dtype)
    if start.ndim < 2 or start.size != math.prod((*shape[:-2], *start.shape[-2:])):
        raise ValueError(
            f"start has shape {start.shape}; give an image of the result's batch and planes, "
            f"{shape[:-2]}, and its rows and columns"
        )
    rows, columns = start.shape[-2:]
    start = start.reshape(*shape[:-2], rows, columns)
    if (rows, columns) == problem.field_shape:
        return start
    corner = [(f - n) // 2 for f, n in zip(problem.field_shape, (rows, columns), strict=True)]
    if min(corner) < 0:
        raise ValueError(
            f"start has {rows}×{columns} pixels, more than the field's {problem.field_shape}"
        )
    return place(start, corner, problem.field_shape)


_level = jax.jit(uniform_level)
