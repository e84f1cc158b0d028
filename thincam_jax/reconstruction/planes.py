"""Planes reconstructed together: none is cheaper than another, and some cannot be told apart."""

import warnings
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core.checks import is_traced
from thincam_jax.imaging.operators.crop_convolution import CropConvolution, plane_mean
from thincam_jax.lensless.method import AccuracyWarning
from thincam_jax.reconstruction.problem import InverseProblem, convolutions, or_one

# Correlation of two planes' PSFs: they differ by 0.5 to 1 pixel at the edge.
_ALIKE = 0.95
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
