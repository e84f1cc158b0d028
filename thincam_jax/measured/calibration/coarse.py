"""Least squares with a narrow minimum: coarse pixels and wide finite differences first.

The phase of the waves diffracted at the aperture's edges changes fast with d. They carry little
light, so that the sum of squares is a smooth bowl in d with a narrow dip at the bottom, but they
dominate its derivative: Levenberg-Marquardt with exact derivatives stalls in a ripple of the bowl.
Finite differences over steps wide enough to average these waves follow the bowl, and full
Gauss-Newton steps cross its ripples, where a monotone search would stop. The differences are
narrowed as long as they stay wide compared with the resulting standard errors.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from thincam_jax._core.grids import Grid, block_mean, central_blocks
from thincam_jax.measured.calibration.problem import (
    SEEN,
    WHERE,
    Covariance,
    FitState,
    covariance,
    model,
    of_values,
    seen_by_steps,
    unknown_names,
    with_fringes_held,
)

_BLOCK = 0.35  # of √(λd): the side of a coarse pixel
_FEWEST = 48  # coarse pixels along a side, at least
_TRIALS = 5  # on either side of the best one
_ROUNDS = 2  # each with a fifth of the previous step
_STEPS = 8  # of Gauss-Newton at each width of the differences
_NEAR_ENOUGH = 0.3  # standard errors; a smaller step is the last
_DAMPING = 1e-4  # relative to the unit diagonal, for degenerate parameters
# The longest step, in widths of the differences: 1 rad at the rim for the fringes, 10 % for d.
_LONGEST = {"background": math.inf, "gain": math.inf, "width": 5.0, "wavelength": 5.0}
_LONGEST_OF_FRINGES = 50.0
_WIDE, _NARROWER, _NARROWEST = 0.02, 0.25, 1e-6  # relative widths
_NARROW_ENOUGH = 2e-4  # for an initial estimate
# Only widths above this many standard errors are narrowed: a quarter is then still three of them,
# and contains the bottom of the bowl.
_AGAINST_ERROR = 12.0
_PARTS = 8  # of the image, along a side
_FRINGE = 0.02  # rad, at the rim: difference step of the fringes' parameters
# Parameters of the edge waves, which need wide differences.
_RIMS = ("width", "wavelength")


@dataclass(frozen=True, eq=False)
class FitImage:
    """An image and its grid, whose centre is `offset` (y, x, mm) from the axis."""

    image: np.ndarray
    grid: Grid
    offset: Float[Array, "2"]
    pixel_integration: bool

    def model(
        self, start: FitState, names: tuple[str, ...], steps: Float[ArrayLike, " unknown"]
    ) -> np.ndarray:
        steps = jnp.asarray(steps, jnp.float64)
        where = (self.pixel_integration, self.grid, self.offset)
        return np.asarray(model(steps, start, names, *where)).ravel()


def descend(
    image: np.ndarray,
    guess: FitState,
    start: FitState,
    parameters: Sequence[str],
    search: float,
    pixel_integration: bool,
) -> FitState:
    """Fit the image on coarse pixels, from a `start` whose fringes are right.

    `guess` is the given state. Only `parameters` change.
    """
    measured = coarse_image(image, guess, pixel_integration)
    best = _best_by_trial(measured, guess, start, parameters, search)
    best = _with_linear(measured, best, parameters)
    names = unknown_names(tuple(parameters))
    width = _WIDE
    while True:
        widths = difference_widths(best, width)
        best, known, turned = _gauss_newton(measured, best, names, widths)
        if width < _NARROW_ENOUGH or _too_narrow(known, turned, widths):
            return best
        width = width * _NARROWER


def _gauss_newton(
    measured: FitImage, start: FitState, names: tuple[str, ...], widths: np.ndarray
) -> tuple[FitState, Covariance, np.ndarray]:
    """Best state after some full steps, its covariance, and the slopes of `SEEN`."""
    here, none, tried = start, np.zeros(len(names)), []
    for _ in range(_STEPS):
        residual = _residual(measured, here, names)
        turned = np.asarray(seen_by_steps(here, names, none))
        jacobian = _seen_slopes(measured, here, turned, widths) @ turned
        known = _errors(jacobian, float(residual @ residual))
        tried.append((float(residual @ residual), here, known, turned))
        norms = np.linalg.norm(jacobian, axis=0)
        unit = jacobian / np.where(norms > 0, norms, 1.0)
        damped = unit.T @ unit + _DAMPING * np.eye(len(names))
        step = -np.linalg.solve(damped, unit.T @ residual) / np.where(norms > 0, norms, 1.0)
        if np.all(np.abs(step) < _NEAR_ENOUGH * known.standard_errors):
            break
        longest = widths * [_LONGEST.get(name, _LONGEST_OF_FRINGES) for name in SEEN]
        step /= max(1.0, float(np.max(np.abs(turned @ step) / longest)))
        here = here.moved(names, jnp.asarray(step))
    return min(tried, key=lambda one: one[0])[1:]


def covariance_by_differences(
    measured: FitImage, found: FitState, names: tuple[str, ...]
) -> tuple[Covariance, Covariance]:
    """Covariances of the steps from `found`, for white noise and from parts of the image.

    By finite differences, narrowed as long as they are wide compared with the errors: exact
    derivatives would rely on edge waves that may be lost in noise. The second, from the scatter of
    `_PARTS`² parts of the image, agrees with the first where the residual is white noise and is
    larger where the model is incomplete.
    """
    residual = _residual(measured, found, names)
    squares, width, seen = float(residual @ residual), _WIDE, None
    turned = np.asarray(seen_by_steps(found, names, np.zeros(len(names))))
    while True:
        widths = difference_widths(found, width)
        seen = _seen_slopes(measured, found, turned, widths, seen)
        known = _errors(seen @ turned, squares)
        if width < _NARROWEST or _too_narrow(known, turned, widths):
            return known, _errors_of_parts(seen @ turned, residual, measured.image.shape)
        width = width * _NARROWER


def slope_norms(measured: FitImage, state: FitState, names: tuple[str, ...]) -> np.ndarray:
    """Norm of the image's change for a unit step of each unknown."""
    widths = difference_widths(state, _WIDE * _NARROWER)
    turned = np.asarray(seen_by_steps(state, names, np.zeros(len(names))))
    norms = np.linalg.norm(_seen_slopes(measured, state, turned, widths) @ turned, axis=0)
    return np.where(norms > 0, norms, 1.0)


def difference_widths(state: FitState, width: float) -> np.ndarray:
    """Half the difference step of each of `SEEN`; `width` is that of λdM."""
    camera = state.camera
    pixel = float(camera.sensor.pitch)
    reach = max(camera.sensor.shape) * pixel / 2
    curvature = float(state.mask.beta) / float(state.magnification) ** 2
    zone = math.sqrt(float(state.wavelength) * float(camera.distance))
    every = {
        "beta": _FRINGE / (curvature * reach**2),
        "centre_y": _FRINGE / (2 * curvature * reach * pixel),
        "centre_x": _FRINGE / (2 * curvature * reach * pixel),
        # For a `width` of 2 % a rim moves by a few per cent of a Fresnel zone.
        "width": 2 * width * zone / float(state.mask.width),
        "wavelength": width,
    }
    return np.array([every.get(name, _FRINGE) for name in SEEN])


def _too_narrow(known: Covariance, turned: np.ndarray, widths: np.ndarray) -> bool:
    """Whether the errors of the edge waves' parameters have reached the difference steps."""
    errors = of_values(known, turned).standard_errors
    rims = [name in _RIMS and bool(np.any(row)) for name, row in zip(SEEN, turned, strict=True)]
    return not any(rims) or bool(np.any((_AGAINST_ERROR * errors > widths)[rims]))


def _errors(jacobian: np.ndarray, squares: float) -> Covariance:
    pixels, unknowns = jacobian.shape
    return covariance(jacobian.T @ jacobian, squares / max(1, pixels - unknowns))


def _errors_of_parts(jacobian: np.ndarray, residual: np.ndarray, shape) -> Covariance:
    """(JᵀJ)⁻¹ (Σ sᵢsᵢᵀ) (JᵀJ)⁻¹ with the slope sᵢ = Jᵢᵀrᵢ of each part (Liang and Zeger 1986)."""
    down, across = (np.arange(n) * _PARTS // n for n in shape[-2:])
    part = np.broadcast_to(down[:, None] * _PARTS + across, shape).ravel()
    slopes = np.stack([np.bincount(part, column * residual) for column in jacobian.T], axis=1)
    slopes -= slopes.mean(axis=0)
    return covariance(jacobian.T @ jacobian, slopes.T @ slopes * _PARTS**2 / (_PARTS**2 - 1))


def _residual(measured: FitImage, here: FitState, names) -> np.ndarray:
    return measured.model(here, names, np.zeros(len(names))) - measured.image.ravel()


def _seen_slopes(measured: FitImage, here: FitState, turned, widths, known=None) -> np.ndarray:
    """Central differences in each of `SEEN`, 0 where no unknown changes it.

    Of `known` slopes only those of the edge waves are renewed.
    """
    slopes = np.zeros((measured.image.size, len(SEEN)))
    for i, name in enumerate(SEEN):
        if known is not None and name not in _RIMS:
            slopes[:, i] = known[:, i]
        elif np.any(turned[i]):
            step = np.zeros(len(SEEN))
            step[i] = widths[i]
            change = measured.model(here, SEEN, step) - measured.model(here, SEEN, -step)
            slopes[:, i] = change / (2 * widths[i])
    return slopes


def _best_by_trial(
    measured: FitImage, guess: FitState, start: FitState, parameters: Sequence[str], search: float
) -> FitState:
    """The start with the distance, or wavelength, and the width that fit the coarse image best.

    Within the relative range `search` of the guess, for free `parameters`. With a free β the
    fringes' curvature β/M² is held.
    """
    tried = [n for n in ("distance", "wavelength") if n in parameters][:1]
    tried = [n for n in ("width",) if n in parameters] + tried
    if not tried or search == 0:
        return start
    best = start
    for turn in range(_ROUNDS):
        for name in tried:
            # The full range first, with the value from the fringes among the trials.
            middle = float(WHERE[name](guess if turn == 0 else best))
            values = middle * _trials(name, search / _TRIALS**turn, guess)
            values = np.append(values, float(WHERE[name](best)))
            trials = [with_fringes_held(best, name, v, "beta" in parameters) for v in values]
            best = trials[int(np.argmin([_misfit(measured, trial) for trial in trials]))]
    return best


def _trials(name: str, reach: float, guess: FitState) -> np.ndarray:
    """Factors from 1 − reach to 1 + reach, less than a Fresnel zone apart at the rim."""
    count = _TRIALS
    if name == "width":
        zone = math.sqrt(float(guess.wavelength) * float(guess.camera.distance))
        count = max(count, math.ceil(reach * float(guess.mask.width) / zone))
    return 1 + reach * np.arange(-count, count + 1) / count


def _misfit(measured: FitImage, state: FitState) -> float:
    """1 − ρ², with the correlation ρ of image and model: the misfit at the best gain and offset."""
    h = measured.model(state, ("phase",), np.zeros(1))
    return 1 - float(np.corrcoef(h, measured.image.ravel())[0, 1]) ** 2


def full_image(image: np.ndarray, state: FitState, pixel_integration: bool) -> FitImage:
    return FitImage(image, state.camera.sensor.grid, jnp.zeros(2), pixel_integration)


def coarse_image(image: np.ndarray, guess: FitState, pixel_integration: bool) -> FitImage:
    """The image averaged over blocks of about a third of a Fresnel zone; remainders are dropped.

    The model is exact for these pixels, too.
    """
    pitch = float(guess.camera.sensor.pitch)
    zone = math.sqrt(float(guess.wavelength) * float(guess.camera.distance))
    shape = image.shape[-2:]
    size = max(1, min(round(_BLOCK * zone / pitch), min(shape) // _FEWEST))
    kept = central_blocks(shape, size)
    averages = block_mean(image[..., *kept], size)
    middles = np.array([(part.start + part.stop) / 2 for part in kept])
    offset = (middles - np.array(shape) / 2) * pitch
    return FitImage(
        averages,
        Grid(averages.shape[-2:], pitch * size),
        jnp.asarray(offset),
        size > 1 or pixel_integration,
    )


def _with_linear(measured: FitImage, state: FitState, parameters: Sequence[str]) -> FitState:
    """Fit a free background and gain by linear least squares."""
    h = measured.model(state, ("phase",), np.zeros(1))
    values = measured.image.ravel()
    flat = np.broadcast_to(np.asarray(state.flat), measured.image.shape).ravel()
    columns = {"background": flat, "gain": h}
    free = [name for name in columns if name in parameters]
    found = {"background": 0.0, "gain": 1.0}
    if free:
        rest = values if "gain" in free else values - h
        solution = np.linalg.lstsq(np.stack([columns[n] for n in free], axis=1), rest)[0]
        found |= dict(zip(free, solution, strict=True))
    if not found["gain"] > 0:  # another camera's image; some gain, so that the model has a slope
        found["gain"] = values.std() / h.std()
    return state.with_numbers(**{name: jnp.asarray(n, jnp.float64) for name, n in found.items()})
