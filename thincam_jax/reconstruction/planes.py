"""Planes reconstructed together: their brightness, and low frequencies as far as PSFs are right."""

import dataclasses
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core.checks import is_traced
from thincam_jax._core.precision import AccuracyWarning
from thincam_jax.imaging.operators.crop_convolution import CropConvolution, plane_mean
from thincam_jax.reconstruction.iterate import Outcome
from thincam_jax.reconstruction.problem import InverseProblem, convolutions, or_one
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.smooth_misfit import misfit_of
from thincam_jax.reconstruction.uniform_light import high_passed, window_length

# Correlation of two planes' PSFs: they differ by 0.5 to 1 pixel at the edge.
_ALIKE = 0.95
# Smooth misfit of measured PSFs relative to the light: shading, a pedestal, stray light. Where as
# much is `_HIDDEN` times the noise or more, noise hides it, and low frequencies count in full.
_SMOOTH, _HIDDEN = 0.03, 0.1
_FINEST = 0.25  # cycles/pixel; above it are the noise of measured PSFs and little light
# Smooth residual over the noise below which low frequencies have not misled: 1.0 to 1.6 through
# right PSFs; 3 with shading of 1 %, 7 to 16 where light went to another plane. After as many
# iterations as suffice through right PSFs at 30 dB of noise, more than 5 does not end there.
_RIGHT, _HOPEFUL, _FIRST = 1.7, 5.0, 100


def with_equal_planes(
    problem: InverseProblem,
) -> tuple[InverseProblem, Float[Array, "plane 1 1"] | None]:
    r"""The problem of the image times u, in which all planes' PSFs are equally bright, and u.

    .. math:: u_p = \Big(\sum_k \max(w_k) \sum h_{kp}^2 \,/\, \text{mean over planes}\Big)^{1/2}

    The total variation of a plane is then weighted by the noise back-projected into it, as τ is
    defined. With one weight for all, light goes to the plane of the brightest PSF, in which less
    image, and so less variation, explains as much: to the farthest one, whose shadow is smallest.

    u is None for one plane, and for operators that are no convolutions.
    """
    operators = convolutions(problem)
    if operators is None or operators[0].spectrum.shape[-3] == 1:
        return problem, None
    powers = [
        jnp.max(weight) * jnp.sum(plane_mean(jnp.abs(o.spectrum) ** 2, o.window[1]), axis=0)
        for o, weight in zip(operators, problem.weights, strict=True)
    ]
    total = jnp.sum(jnp.stack(powers), axis=0)
    unit = or_one(jnp.sqrt(total / or_one(jnp.mean(total))))[:, None, None]
    spectra = [o.spectrum / unit.astype(o.spectrum.dtype) for o in operators]
    return eqx.tree_at(lambda p: [o.spectrum for o in p.operators], problem, spectra), unit


def without_smooth_misfit(problem: InverseProblem) -> InverseProblem:
    r"""A problem of several planes in which low frequencies weigh as much as they can be trusted.

    Planes differ in the fine detail of their PSFs, and captures have most of their light at low
    frequencies. A PSF that is wrong there by a part ε (a pedestal, shading, stray light) has light
    explained by the plane whose shadow has the size wanted, mostly the farthest, whatever the
    detail says. The high-pass δ − (1 − η) w of captures and PSFs, as of `without_uniform_light`,
    keeps of the frequencies that a Hann window w of n pixels passes as much as makes this misfit
    as strong as the noise,

    .. math:: \eta = \frac{\sigma\,\|w\|}{\epsilon\,\mathrm{rms}(g)},\qquad
        \|w\| = \frac{1.5}{n + 1},\quad \epsilon = 0.03,

    and hundreds of iterations become some 50. A capture with more noise (η > 0.1) stays as it is.
    """
    window, kept = 1.5 / (window_length(problem) + 1), []
    for weight, capture in zip(problem.weights, problem.captures, strict=True):
        light = jnp.mean(jnp.where(weight > 0, capture, 0) ** 2)
        kept.append(window / (_SMOOTH * float(jnp.sqrt(or_one(jnp.max(weight) * light)))))
    filtered = high_passed(problem, [k if k < _HIDDEN else 1.0 for k in kept])
    return problem if filtered is None else filtered


def with_smooth_light(
    problem: InverseProblem, outcome: Outcome, minimise: Callable[[Image, int], Outcome], most: int
) -> Outcome:
    """The image from which all light is explained, where PSFs explain it; else that of an outcome.

    Through PSFs that are right the low frequencies hold 1 to 4 dB. From the image that is found
    without them little light has to move, and the residual's smooth part ends as that of the noise.
    What wrong PSFs leave there is several times as much, whatever plane takes it.

    - `problem`: that with the low frequencies in full.
    - `outcome`: that of `without_smooth_misfit`.
    - `minimise`: outcome of the problem from an image, after so many iterations at most.
    - `most`: iterations for all of it.
    """

    def smooth(one: Outcome) -> float:
        left = misfit_of(problem, one.image)
        return math.inf if left is None else max(left.smooth)

    again = minimise(outcome.image, min(_FIRST, most))
    left = smooth(again)
    if again.status == "iterations_exhausted" and most > _FIRST and left < _HOPEFUL:
        again = again.followed_by(minimise(again.image, most - _FIRST))
        left = smooth(again)
    seconds = outcome.seconds + again.seconds
    if again.status in ("stopped", "interrupted"):
        return dataclasses.replace(outcome, status=again.status, seconds=seconds)
    if again.status != "non_finite" and left < _RIGHT:
        outcome = dataclasses.replace(again, reason=outcome.reason)
    return dataclasses.replace(outcome, seconds=seconds)


def warn_of_equal_planes(operators: list[CropConvolution], weights: Sequence[Any]) -> None:
    """Name neighbouring planes whose PSFs cannot be told apart in an `AccuracyWarning`.

    Their gradients below 0.25 cycles/pixel correlate by more than 0.95, at the best shift.
    """
    spectra = [o.spectrum for o in operators]
    if spectra[0].shape[-3] == 1 or any(map(is_traced, (*spectra, *weights))):
        return
    alike = _correlations(spectra, weights, operators[0].window)
    pair = int(jnp.argmax(alike))
    if float(alike[pair]) > _ALIKE:
        warnings.warn(
            f"planes {pair} and {pair + 1} of {len(alike) + 1} have PSFs that correlate by "
            f"{float(alike[pair]):.3f}: their light cannot be told apart; give planes farther "
            "apart, or use thincam_jax.reconstruction.depth.refocus_sweep and its depth_map",
            AccuracyWarning,
            stacklevel=8,
        )


@eqx.filter_jit
def _correlations(spectra, weights, window: tuple[int, int]):
    """The correlation of each plane's gradient with the next one's."""
    v, u = jnp.fft.fftfreq(window[0])[:, None], jnp.fft.rfftfreq(window[1])
    frequency = jnp.sqrt(v**2 + u**2).astype(spectra[0].real.dtype)
    fine = jnp.where(frequency < _FINEST, frequency, 0)
    gains = [
        (jnp.sqrt(jnp.max(w)) * fine).astype(s.dtype) for s, w in zip(spectra, weights, strict=True)
    ]
    slopes = jnp.concatenate([s * gain for s, gain in zip(spectra, gains, strict=True)])
    sizes = jnp.sqrt(jnp.sum(plane_mean(jnp.abs(slopes) ** 2, window[1]), axis=0))
    crossed = jnp.sum(slopes[:, :-1].conj() * slopes[:, 1:], axis=0)
    most = jnp.max(jnp.fft.irfft2(crossed, s=window), axis=(-2, -1))
    return most / or_one(sizes[:-1] * sizes[1:])
