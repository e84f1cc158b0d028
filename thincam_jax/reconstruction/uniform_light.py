"""High-passed problems, in which uniform or smooth light counts less or not at all."""

import dataclasses
import functools
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from thincam_jax._core.quick_programs import quickly_compiled
from thincam_jax.imaging.operators.crop_convolution import CropConvolution, cut, place
from thincam_jax.reconstruction.iterate import Callback, Outcome, Schedule, iterate
from thincam_jax.reconstruction.parallel import in_parallel
from thincam_jax.reconstruction.problem import (
    InverseProblem,
    compiled_objective,
    convolutions,
    or_one,
    residuals,
    uniform_level,
)
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.splittings import admm_method

# A camera is biased if its response at zero frequency is this many times the root mean square of
# all: for a zone aperture 0.7 times its width in pixels, almost nothing where the background
# cancels. At 30 dB this start harms or changes nothing up to 100, and gains from 190 on.
_BIASED = 150.0

# Shorter side of the sensor over the side of the high-pass window, and the smallest window.
_PART, _SMALLEST = 8, 5

# Least share of the valid pixels that must remain.
_LEAST_SHARE = 0.25


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
    biases = jax.device_get(_biases(operators))
    return high_passed(problem, [0.0 if bias > _BIASED else 1.0 for bias in biases])


def begin_without(
    problem: InverseProblem, image: Image, schedule: Schedule, callback: Callback | None
) -> Outcome | None:
    """First iterations of ADMM, without uniform light; None for an unbiased camera."""
    easier = without_uniform_light(problem)
    if easier is None:
        return None
    objective = functools.partial(objective_with_uniform_light, problem)
    method = in_parallel(easier, admm_method)
    outcome = iterate(method, image, schedule, callback=callback, objective=objective)
    return dataclasses.replace(outcome, image=with_uniform_light(problem, outcome.image))


def window_length(problem: InverseProblem) -> int:
    """Side of the high-pass window, an odd number of pixels."""
    shortest = min(min(c.shape[-2:]) for c in problem.captures)
    return 2 * (shortest // (2 * _PART)) + 1


def high_passed(problem: InverseProblem, kept: Sequence[float]) -> InverseProblem | None:
    """Convolutions and captures filtered with δ − (1 − kept) w, see `without_uniform_light`.

    - `kept`: part kept of each capture's zero frequency; 1 leaves a capture as it is.

    None if all are, or few pixels remain.
    """
    rows, length = tuple(k < 1 for k in kept), window_length(problem)
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
    removed = 1 - jnp.asarray(kept, problem.captures[0].dtype)
    return _high_passed(problem, rows, removed, length)


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


@quickly_compiled
def _biases(operators: tuple[CropConvolution, ...]) -> list[Float[Array, ""]]:
    uniform = [jnp.max(jnp.abs(o.spectrum[..., 0, 0])) for o in operators]
    return [u / jnp.sqrt(or_one(o.mean_power())) for u, o in zip(uniform, operators, strict=True)]


@eqx.filter_jit
def _high_passed(problem: InverseProblem, rows: tuple[bool, ...], removed, length: int):
    """High-pass the spectra and captures of the given rows."""
    operators, captures = list(convolutions(problem) or ()), list(problem.captures)
    window = operators[0].window
    low = jnp.asarray(window_transfer(length, window), problem.captures[0].dtype)

    def filtered(capture, corner, transfer):
        spectrum = jnp.fft.rfft2(place(capture, corner, window))
        whole = jnp.fft.irfft2(spectrum * transfer.astype(spectrum.dtype), s=window)
        return cut(whole, corner, capture.shape[-2:])

    for index, row in enumerate(rows):
        if row:
            operator, transfer = operators[index], 1 - removed[index] * low
            spectrum = operator.spectrum * transfer.astype(operator.spectrum.dtype)
            operators[index] = eqx.tree_at(lambda o: o.spectrum, operator, spectrum)
            captures[index] = filtered(captures[index], operator.sensor_corner, transfer)
    return eqx.tree_at(
        lambda p: (p.operators, p.captures), problem, (tuple(operators), tuple(captures))
    )


def window_transfer(length: int, window: tuple[int, int]) -> np.ndarray:
    """Transfer function of a Hann window of sum 1 in both directions, centred: real."""
    hann = np.hanning(length + 2)[1:-1]
    places = np.arange(length) - length // 2

    def along(frequencies):
        return np.cos(2 * np.pi * np.outer(frequencies, places)) @ hann / hann.sum()

    return np.outer(along(np.fft.fftfreq(window[0])), along(np.fft.rfftfreq(window[1])))
