r"""Captures without their uniform light: what the iterations of a biased camera begin with.

A zone aperture lets a good part of the light through evenly. One frequency of its response, zero,
is then hundreds of times as strong as the others, and an iteration that has to get that one right
moves the others little. A high-pass takes the uniform light away *exactly*, for what is even over
the length of its window is a constant to it, and it commutes with the camera: with g = C(h ∗ f), C
the crop to the sensor,

.. math:: p * g = C'\big((p * h) * f\big), \qquad p = \delta - w,\quad \sum w = 1

on the pixels C′ whose window w lies on the sensor. Only the noise is approximated: at the lowest
frequencies it is weaker than is counted. What is lost is the brightness of the whole and the
outermost pixels, and so the image found is the start for the problem with all of the data.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from thincam_jax.imaging.operators.crop_convolution import CropConvolution, cut, place
from thincam_jax.reconstruction.problem import (
    InverseProblem,
    convolutions,
    residuals,
    uniform_level,
    worth,
)
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.scaled import or_one

# A camera is biased if its response at zero frequency is that many times the root mean square of
# all: for a zone aperture 0.7 times its width in pixels, almost nothing where the background
# cancels. At 30 dB this start harms or changes nothing up to 100, and gains from 190 on.
_BIASED = 150.0
# The window is the sensor's shorter side over this, and something smaller than that is no window.
_PART, _SMALLEST = 8, 5
# Of the pixels that are to be trusted, that many have to be left.
_ENOUGH = 0.25


def high_passed(problem: InverseProblem) -> InverseProblem | None:
    """The problem with what is biased high-passed; None if nothing is, or too little would be left.

    The captures keep their shape: pixels near the border, or near one that is not to be trusted,
    have the weight 0.
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
            trusted = np.broadcast_to(np.asarray(weight) > 0, shape)
            whole = whole_windows(trusted, length)
            if whole.sum() < _ENOUGH * trusted.sum():
                return None
            weights[index] = weight * jnp.asarray(whole, weight.dtype)
            # What stands in the others may be huge, and rounding would spread it over the sensor.
            captures[index] = jnp.where(weight > 0, capture, 0)
    problem = eqx.tree_at(
        lambda p: (p.weights, p.captures), problem, (tuple(weights), tuple(captures))
    )
    return _without_slow_part(problem, rows, length)


def whole_windows(
    trusted: Bool[np.ndarray, "*batch y x"], length: int
) -> Bool[np.ndarray, "*batch y x"]:
    """The pixels in whose window, `length` on a side, all are there and trusted."""
    margin = length // 2
    whole = np.pad(trusted, [(0, 0)] * (trusted.ndim - 2) + [(margin, margin)] * 2)
    for axis in (-2, -1):
        whole = np.min(np.lib.stride_tricks.sliding_window_view(whole, length, axis=axis), axis=-1)
    return whole


@jax.jit
def levelled(problem: InverseProblem, image: Image) -> Image:
    """The image with the uniform light added that explains the captures best, f ≥ 0 if asked."""
    missing = tuple(-r for r in residuals(problem, image))
    level = uniform_level(eqx.tree_at(lambda p: p.captures, problem, missing))
    image = image + level[..., None, None, None]
    return jnp.maximum(image, 0) if problem.nonnegative else image


def levelled_objective(problem: InverseProblem, image: Image) -> Float[Array, "*batch"]:
    """What an image without its uniform light is worth to the problem that has it."""
    return worth(problem, levelled(problem, image))


@jax.jit
def _biases(operators: tuple[CropConvolution, ...]) -> list[Float[Array, ""]]:
    even = [jnp.max(jnp.abs(o.spectrum[..., 0, 0])) for o in operators]
    return [e / jnp.sqrt(or_one(o.mean_power())) for e, o in zip(even, operators, strict=True)]


@eqx.filter_jit
def _without_slow_part(problem: InverseProblem, rows: tuple[bool, ...], length: int):
    """Spectra and captures times the transfer function of the high-pass."""
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
