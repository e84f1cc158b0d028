"""Assembly of the inverse problem of captures and PSFs: window, operators, weights, planes."""

import math
import warnings
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import is_traced
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax._core.precision import AccuracyWarning
from thincam_jax.imaging.operators.crop_convolution import CropConvolution, plane_mean, window_shape
from thincam_jax.reconstruction.problem import InverseProblem, convolutions, or_one
from thincam_jax.reconstruction.uniform_light import high_passed, window_length

# Correlation of two planes' PSFs: they differ by 0.5 to 1 pixel at the edge.
_ALIKE = 0.95
# Smooth misfit of measured PSFs relative to the light: shading, a pedestal, stray light. Where as
# much is `_HIDDEN` times the noise or more, noise hides it, and low frequencies count in full.
_SMOOTH, _HIDDEN = 0.03, 0.1
_FINEST = 0.25  # cycles/pixel; above it are the noise of measured PSFs and little light


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


def convolution_problem(
    channels: Any,  # of `SynthesisRow`
    variances: Sequence[Array],
    pitch: Float[Array, ""],
    field_shape: tuple[int, int],
    settings: dict[str, Any],
) -> InverseProblem:
    """The problem of convolutions on one window."""
    dtype = channels[0].capture.dtype
    windows = [
        window_shape(c.capture.shape[-2:], field_shape, c.kernel.shape[-2:]) for c in channels
    ]
    window = (max(w[0] for w in windows), max(w[1] for w in windows))
    # Captures, kernels and a field, each with its transform, at the least.
    refuse_if_too_large(
        f"a reconstruction on a field of {field_shape[0]}×{field_shape[1]} pixels",
        dtype.itemsize * math.prod(window) * (2 * len(channels) + 3),
        "give a smaller field_shape, fewer pixels or fewer captures",
    )
    operators = [
        CropConvolution(
            c.kernel.astype(dtype),
            pitch.astype(dtype),
            c.capture.shape[-2:],
            field_shape,
            summed=1,
            window=window,
        )
        for c in channels
    ]
    weights = [
        (1.0 if c.valid is None else c.valid.astype(dtype)) / v
        for c, v in zip(channels, variances, strict=True)
    ]
    warn_of_equal_planes(operators, weights)
    return InverseProblem(operators, [c.capture for c in channels], weights=weights, **settings)


def fitting_field(
    field_shape: Sequence[int], sensor: Sequence[int], kernel: Sequence[int]
) -> tuple[int, int]:
    """The field, smaller by one where its centre would not fit the sensor's and PSF's samples."""
    shape = checks.shape2d("field_shape", field_shape)
    sizes = zip(shape, sensor, kernel, strict=True)
    rows, columns = (max(f - (s + f - 1 - k) % 2, 1) for f, s, k in sizes)
    return rows, columns
