"""The least-squares problem of a PSF fit: unknowns, model, residual and covariance."""

import functools
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Float

from thincam_jax._core.grids import Grid
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.lensless.method import PsfMethod
from thincam_jax.lensless.psf import psf

# Parameters that can be fitted, in the order of the tables, with their place in a `FitState`.
WHERE = {
    "beta": operator.attrgetter("camera.mask.beta"),
    "phase": operator.attrgetter("camera.mask.phase"),
    "centre": operator.attrgetter("camera.mask.centre"),
    "width": operator.attrgetter("camera.mask.width"),
    "distance": operator.attrgetter("camera.distance"),
    "object_distance": operator.attrgetter("nearness"),
    "wavelength": operator.attrgetter("wavelength"),
    "background": operator.attrgetter("background"),
    "gain": operator.attrgetter("gain"),
}
PARAMETERS = tuple(WHERE)
Status = Literal["ok", "ambiguous", "poor_fit", "not_converged"]
# Change of the image for a scaled step of 1, relative to its contrast. The solver's initial damping
# of 1 is then weak, as a start within a fraction of a fringe allows.
STEP = 30.0
# Of the scaled steps, and of the weighted residual in any pixel. A million pixels at 30 dB
# determine a scaled step to some 1e-6.
_TOLERANCE = 1e-7
# Fraction of a standard error: convergence is a smaller change in `_STEPS` steps.
CONVERGED = 0.1
_STEPS = 10
_FINEST = 1e-9  # a standard error of a step, where there is no noise


def unknown_names(parameters: tuple[str, ...]) -> tuple[str, ...]:
    """One name for each fitted number; the centre is two."""
    names = []
    for name in PARAMETERS:
        if name in parameters:
            names += ["centre_y", "centre_x"] if name == "centre" else [name]
    return tuple(names)


class Synthesis(eqx.Module):
    """Weighted sum of captures at several phases: its real part, and an imaginary one if complex.

    - `phases`: phase of each capture, rad, added to the mask's.
    - `weights`: weights of the captures in each part.
    """

    phases: Float[Array, " shot"]
    weights: Float[Array, "part shot"]


class FitState(eqx.Module):
    """All parameters of the image of a point source on the axis.

    - `nearness`: 1/t, 1/mm; 0 is a plane wave. Unlike t, it is differentiable at infinity.
    - `synthesis`: sum of several captures; None for one capture.
    - `nodes`: nodes of the average over a pixel; known numbers decide, which here are traced.
    """

    camera: LenslessCamera
    wavelength: Float[Array, ""]
    nearness: Float[Array, ""]
    background: Float[Array, ""]
    gain: Float[Array, ""]
    synthesis: Synthesis | None = None
    nodes: int | None = eqx.field(default=None, static=True)

    @property
    def mask(self) -> FresnelZoneAperture:
        return cast(FresnelZoneAperture, self.camera.mask)

    @property
    def magnification(self) -> Float[Array, ""]:
        """M = 1 + d/t."""
        return 1 + self.camera.distance * self.nearness

    @property
    def flat(self) -> Float[Array, "*part"]:
        """Image of a background of 1 in every capture."""
        if self.synthesis is None:
            return jnp.ones_like(self.background)
        return jnp.sum(self.synthesis.weights, axis=1)[:, None, None]

    def image(self, pixel_integration: bool, grid: Grid | None = None) -> Float[Array, "*part y x"]:
        """background + gain·h, or the weighted sum of these, on the sensor or another grid."""
        if self.synthesis is None:
            h = self._psf(pixel_integration, grid, 0.0)
        else:
            turned = functools.partial(self._psf, pixel_integration, grid)
            h = jax.lax.map(turned, self.synthesis.phases)
            h = jnp.tensordot(self.synthesis.weights, h, axes=1, precision="highest")
        return self.background * self.flat + self.gain * h

    def _psf(self, pixel_integration: bool, grid: Grid | None, phase) -> Float[Array, "y x"]:
        turned = self.mask.phase + phase
        camera = eqx.tree_at(lambda camera: camera.mask.phase, self.camera, turned)
        camera = camera if grid is None else camera.on_grid(grid)
        light: dict[str, Any] = {
            "wavelength": self.wavelength,
            "object_distance": 1 / self.nearness,
        }
        method = PsfMethod(nodes=self.nodes)
        return psf(camera, **light, model=method, pixel_integration=pixel_integration)

    def moved(self, names: tuple[str, ...], steps: Float[Array, " unknown"]) -> "FitState":
        """State after dimensionless steps of the named parameters.

        β/M², width, d and λ change by the factor e^s, which keeps them positive; 1/t by s/d; the
        centre by s pixels; phase (rad), background and gain by s. A free β follows d and t, so that
        the fringes stay: d and t then act through diffraction and the size of the shadow only.
        """
        s = dict(zip(names, steps, strict=True))
        mask, pitch = self.mask, self.camera.sensor.pitch
        none = jnp.zeros_like(steps[0])
        nearness = self.nearness
        if "object_distance" in s:  # else unchanged: t(1/t) has no derivative at 0
            nearness = nearness + s["object_distance"] / self.camera.distance
        offset = jnp.stack([s.get("centre_y", none), s.get("centre_x", none)])
        distance = self.camera.distance * jnp.exp(s.get("distance", none))
        beta = mask.beta
        if "beta" in s:
            grown = (1 + distance * nearness) / self.magnification
            beta = beta * jnp.exp(s["beta"]) * grown**2
        return self.with_numbers(
            beta=beta,
            phase=mask.phase + s.get("phase", none),
            centre=mask.centre + offset * pitch,
            width=mask.width * jnp.exp(s.get("width", none)),
            distance=distance,
            object_distance=nearness,
            wavelength=self.wavelength * jnp.exp(s.get("wavelength", none)),
            background=self.background + s.get("background", none),
            gain=self.gain + s.get("gain", none),
        )

    def with_numbers(self, **numbers: Array) -> "FitState":
        """State with other values by their names in `PARAMETERS`; 1/t for object_distance."""
        return eqx.tree_at(
            lambda s: [WHERE[name](s) for name in numbers], self, [*numbers.values()]
        )

    def values(self, names: tuple[str, ...]) -> Float[Array, " unknown"]:
        """Values of the named parameters: mm, rad/mm², rad; 1/t in 1/mm for object_distance."""
        every = {name: where(self) for name, where in WHERE.items()}
        every["centre_y"], every["centre_x"] = every["centre"]
        return jnp.stack([every[name] for name in names])


def with_fringes_held(state: FitState, name: str, value: float, hold: bool) -> FitState:
    """State with another width, distance or wavelength; `hold`: with β/M² held by β."""
    there = state.with_numbers(**{name: jnp.asarray(value, state.nearness.dtype)})
    if not hold:
        return there
    ratio = there.magnification / state.magnification
    return there.with_numbers(beta=there.mask.beta * ratio**2)


class FitProblem(eqx.Module):
    """The data of `residual`.

    - `start`: the state of zero steps.
    - `image`: measured image.
    - `weight`: weight of the residuals.
    - `scale`: the step of each unknown that changes the image by `STEP` (Marquardt's scaling,
      without which 1 % of β, many rad, would be damped like 1 % of a rad).
    - `names`, `pixel_integration`: result of `unknown_names` and argument of `psf`; static.
    """

    start: FitState
    image: Float[Array, "*part y x"]
    weight: Float[Array, ""]
    scale: Float[Array, " unknown"]
    names: tuple[str, ...] = eqx.field(static=True)
    pixel_integration: bool = eqx.field(static=True)


class Solution(eqx.Module):
    """Result of Levenberg-Marquardt, with its number of steps.

    - `moved`: change of each unknown in the last `_STEPS` steps, in standard errors.
    """

    scaled: Float[Array, " unknown"]
    moved: Float[np.ndarray, " unknown"]
    iterations: int


def state_at(scaled: Float[Array, " unknown"], problem: FitProblem) -> FitState:
    """State after the steps `scaled`·`problem.scale`."""
    return problem.start.moved(problem.names, scaled * problem.scale)


def residual(scaled: Float[Array, " unknown"], problem: FitProblem) -> Float[Array, "*part y x"]:
    """(model − measured image)·weight."""
    model = state_at(scaled, problem).image(problem.pixel_integration)
    return (model - problem.image) * problem.weight


@eqx.filter_jit
def model(
    steps: Float[Array, " unknown"],
    start: FitState,
    names: tuple[str, ...],
    pixel_integration: bool,
    grid: Grid,
    offset: Float[Array, "2"],
) -> Float[Array, "*part y x"]:
    """Image after the steps, on a grid centred `offset` (y, x, mm) from the sensor's centre."""
    state = start.moved(names, steps)
    # The grid's centre is its origin, so the mask moves the other way.
    state = state.with_numbers(centre=state.mask.centre - offset / state.magnification)
    return state.image(pixel_integration, grid)


# Independent parameters of the image, each with its own step: β/M², φ, M·centre, M·width, λdM, and
# the linear ones. d and t act through M and λdM only, so that λ's step is that of λdM.
SEEN = ("beta", "phase", "centre_y", "centre_x", "width", "wavelength", "background", "gain")


@eqx.filter_jit
def seen_by_steps(
    start: FitState, names: tuple[str, ...], steps: Float[ArrayLike, " step"]
) -> Float[Array, "seen step"]:
    """Derivative of `SEEN` in the steps: exact, also for steps of equal effect."""
    return jax.jacfwd(_seen)(steps, start, names)


def _seen(steps, start: FitState, names):
    there = start.moved(names, steps)
    mask, scale = there.mask, there.magnification
    centre = mask.centre * scale / jax.lax.stop_gradient(scale) / there.camera.sensor.pitch
    numbers = (
        jnp.log(mask.beta / scale**2),
        mask.phase,
        centre[0],
        centre[1],
        jnp.log(mask.width * scale),
        jnp.log(there.wavelength * there.camera.distance * scale),
        there.background,
        there.gain,
    )
    return jnp.stack(numbers)


@eqx.filter_jit
def values_by_steps(
    start: FitState, names: tuple[str, ...], steps: Float[ArrayLike, " step"]
) -> Float[Array, "value step"]:
    """The derivative of `FitState.values` in the steps from `start`."""
    return jax.jacfwd(lambda s: start.moved(names, s).values(names))(steps)


@eqx.filter_jit
def state_and_residual(
    scaled: Float[Array, " unknown"], problem: FitProblem
) -> tuple[FitState, Float[Array, "*part y x"]]:
    """State, and measured image − model."""
    return state_at(scaled, problem), -residual(scaled, problem) / problem.weight


def solve(problem: FitProblem, errors: Float[np.ndarray, " unknown"], max_steps: int) -> Solution:
    """Levenberg-Marquardt from `problem.start` until changes are small against the errors.

    `errors`: standard errors of the steps. It restarts every few steps, because in the ripples that
    the edge waves cause the damping would grow until nothing moves, at a minimum or not.
    """
    errors = np.maximum(errors, _FINEST) / np.asarray(problem.scale)
    found, moved, iterations = jnp.zeros_like(problem.scale), np.inf * errors, 0
    while iterations < max_steps and not np.all(moved < CONVERGED):
        solution = _least_squares(problem, found)
        moved = np.abs(np.asarray(solution.value - found)) / errors
        found, iterations = solution.value, iterations + int(solution.stats["num_steps"])
    return Solution(found, moved, iterations)


@eqx.filter_jit
def _least_squares(problem: FitProblem, start: Float[Array, " unknown"]):
    solver = optx.LevenbergMarquardt(rtol=_TOLERANCE, atol=_TOLERANCE)
    return optx.least_squares(residual, solver, start, problem, max_steps=_STEPS, throw=False)


# Two parameters of correlation ρ have standard errors 1/√(1−ρ²) times those with the other one
# known: at 0.999, 22 times. The image then determines one combination more than ten times better
# than either, and any small flaw of the model biases the difference.
AMBIGUOUS = 0.999
# Smallest eigenvalue, relative to the unit diagonal, above rounding.
_SMALLEST = 1e-13
# Smallest eigenvalue of JᵀJ with a unit diagonal for two parameters of that correlation.
_HARDLY_SEEN = 1 - AMBIGUOUS


@dataclass(frozen=True, eq=False)
class Covariance:
    """Standard errors and correlations of the unknowns of a fit."""

    standard_errors: np.ndarray
    correlation: np.ndarray


def covariance(curvature: np.ndarray, variance: float | np.ndarray) -> Covariance:
    """σ²(JᵀJ)⁻¹, or (JᵀJ)⁻¹V(JᵀJ)⁻¹, as standard errors and correlations.

    `curvature`: JᵀJ. `variance`: σ² of a white residual, or V, the covariance of Jᵀr. An
    undetermined direction gets, in place of an infinite error, that of an eigenvalue at rounding
    level: some 1e6 times the error of a well-determined one.
    """
    norm = np.sqrt(np.diag(curvature))
    norm = np.where(norm > 0, norm, norm.max() * _SMALLEST or 1.0)
    values, vectors = np.linalg.eigh(curvature / np.outer(norm, norm))
    inverse = (vectors / np.maximum(values, _SMALLEST)) @ vectors.T
    if np.ndim(variance):
        inverse = inverse @ (variance / np.outer(norm, norm)) @ inverse
    else:
        inverse = inverse * variance
    spread = np.sqrt(np.diag(inverse))
    correlation = inverse / np.outer(spread, spread)
    return Covariance(spread / norm, np.clip(correlation, -1.0, 1.0))


def of_values(steps: Covariance, slopes: np.ndarray) -> Covariance:
    """Covariance of values from that of steps, with `slopes` ∂values/∂steps."""
    scaled = slopes * steps.standard_errors
    whole = scaled @ steps.correlation @ scaled.T
    errors = np.sqrt(np.diag(whole))
    safe = np.where(errors > 0, errors, 1.0)
    return Covariance(errors, np.clip(whole / np.outer(safe, safe), -1.0, 1.0))


def verdict(
    alike: Sequence[str], poor: str = "", unfinished: str = ""
) -> tuple[Status, tuple[str, ...]]:
    """Status of a fit and its reasons, the worst first.

    `alike`: one line for each undetermined parameter; `poor`: why the model does not fit;
    `unfinished`: how the least squares stopped.
    """
    status: Status = "ambiguous" if alike else "ok"
    if poor:
        status = "poor_fit"
    if unfinished:
        status = "not_converged"
    return status, tuple(filter(None, (unfinished, poor, *alike)))


def ambiguous_pairs(names: tuple[str, ...], correlation: np.ndarray) -> list[str]:
    """One line for each pair of indistinguishable unknowns, the most correlated first."""
    rows, columns = np.triu_indices(len(names), 1)
    pairs = sorted(zip(-abs(correlation[rows, columns]), rows, columns, strict=True))
    return [
        f"{names[i]} and {names[j]} cannot be told apart: their correlation is "
        f"{correlation[i, j]:.6f}; fix one of them"
        for rho, i, j in pairs
        if -rho > AMBIGUOUS
    ]


def hardly_seen(names: tuple[str, ...], curvature: np.ndarray) -> list[str]:
    """One line for each poorly determined combination of parameters, the worst first."""
    norm = np.sqrt(np.diag(curvature))
    unseen = [names[index] for index in np.flatnonzero(norm == 0)]
    lines = [f"these data do not see {name} at all; hold it" for name in unseen]
    norm = np.where(norm > 0, norm, 1.0)
    strengths, vectors = np.linalg.eigh(curvature / np.outer(norm, norm) + np.diag(norm == 0))
    for strength, vector in zip(strengths, vectors.T, strict=True):
        if strength < _HARDLY_SEEN:
            together = [n for n, v in zip(names, vector, strict=True) if abs(v) > 0.2]
            lines.append(
                f"{', '.join(together[:-1])} and {together[-1]} cannot be told apart by these "
                f"data: together their errors are {max(strength, 1e-15) ** -0.5:.0f} times those "
                "of each alone; hold one of them"
            )
    return lines
