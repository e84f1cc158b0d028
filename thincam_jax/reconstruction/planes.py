"""Planes reconstructed together: none is cheaper than another, and some cannot be told apart."""

import warnings

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

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

    u is None for one plane, and for operators that are no convolutions. An `AccuracyWarning` names
    neighbouring planes whose PSFs cannot be told apart: a correlation above 0.95 of their
    gradients below 0.25 cycles/pixel, at the best shift.
    """
    operators = convolutions(problem)
    if operators is None or operators[0].spectrum.shape[-3] == 1:
        return problem, None
    gains = [jnp.sqrt(jnp.max(weight)) for weight in problem.weights]
    powers, alike = _compared([o.spectrum for o in operators], gains, operators[0].window)
    pair = int(jnp.argmax(alike))
    if float(alike[pair]) > _ALIKE:
        warnings.warn(
            f"planes {pair} and {pair + 1} of {len(powers)} have PSFs that correlate by "
            f"{float(alike[pair]):.3f}: their light cannot be told apart; give planes farther "
            "apart, or use thincam_jax.reconstruction.depth.refocus_sweep and its depth_map",
            AccuracyWarning,
            stacklevel=5,
        )
    unit = or_one(jnp.sqrt(powers / or_one(jnp.mean(powers))))[:, None, None]
    spectra = [o.spectrum / unit.astype(o.spectrum.dtype) for o in operators]
    return eqx.tree_at(lambda p: [o.spectrum for o in p.operators], problem, spectra), unit


@eqx.filter_jit
def _compared(spectra, gains, window: tuple[int, int]):
    """Σ w h² of each plane, and the correlation of each with the next."""
    v, u = jnp.fft.fftfreq(window[0])[:, None], jnp.fft.rfftfreq(window[1])
    frequency = jnp.sqrt(v**2 + u**2).astype(gains[0].dtype)
    fine = jnp.where(frequency < _FINEST, frequency, 0)
    powers = crossed = slopes = jnp.zeros((), frequency.dtype)
    for spectrum, gain in zip(spectra, gains, strict=True):
        spectrum = spectrum * gain.astype(spectrum.dtype)
        powers = powers + jnp.sum(_images(spectrum, window) ** 2, axis=(0, 2, 3))
        spectrum = spectrum * fine.astype(spectrum.dtype)
        slopes = slopes + jnp.sum(_images(spectrum, window) ** 2, axis=(0, 2, 3))
        pairs = spectrum[:, :-1].conj() * spectrum[:, 1:]
        crossed = crossed + jnp.sum(_images(pairs, window), axis=0)
    sizes = jnp.sqrt(slopes[:-1] * slopes[1:])
    return powers, jnp.max(crossed, axis=(-2, -1)) / or_one(sizes)


def _images(spectra, window: tuple[int, int]):
    return jnp.fft.irfft2(spectra, s=window)
