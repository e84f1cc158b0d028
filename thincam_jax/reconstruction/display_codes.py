"""Whether captures are codes for a display, as an image file of a phone or a web camera has them.

Codes grow with about the 1/2.2th power of the light. A reconstruction explains them nearly as well
as light, by an image of wrong contrast. Two facts tell: the noise of a sensor grows with its light
or is even, that of codes is even or falls; and codes fit about as well when they are decoded, light
fits worse. With limits set on other scenes and PSFs none of 400 captures of light was taken for
codes (four PSFs, noise that grows or is even, with a PSF 4 % too small, ambient light, flat fields,
a median filter), and 9 of 10 of sRGB were; of a gamma of 1.8, which costs less, 1 of 9.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from thincam_jax._core.checks import holds_traced
from thincam_jax.reconstruction.coarse import coarsened
from thincam_jax.reconstruction.imaging_model import Psfs
from thincam_jax.reconstruction.noise import estimate_variance
from thincam_jax.reconstruction.other_psf import LARGEST, noise_growth
from thincam_jax.reconstruction.problem import InverseProblem, start_image
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularised import AdmmTV

CODES = (
    "the captures' noise does not grow with their light, and they fit about as well decoded: if "
    "they are codes for a display (gamma), give raw frames, or (captures / 255) ** 2.2"
)
_POWER = 2.2
# Limits of the noise of bright pixels over that of dark ones, of the contrast of a capture over its
# noise, and of the objective of decoded captures over that of the captures as they are.
_FALLING, _SEEN, _FITS_LESS = 0.85, 5.0, 1.5
_EVEN, _CLEAR, _FITS = 1.2, 12.0, 1.2
_COARSER = 2  # times twice as large
_MOST = 2**_COARSER * LARGEST  # pixels of the field's shorter side; larger ones are not looked at


def display_codes(recording: Recording) -> str:
    """A sentence where captures behind measured PSFs may be codes for a display, else nothing."""
    model = recording.imaging_model
    if not isinstance(model, Psfs) or holds_traced((model.psfs, recording.captures)):
        return ""
    if model.field_shape is None and min(recording.captures[0].shape[-2:]) > _MOST:
        return ""  # before a problem is made of large captures
    problem = recording.problem()
    if problem.image_shape[-3] > 1 or min(problem.field_shape) > _MOST:
        return ""
    growth = noise_growth(problem)
    least, most = (_SEEN, _FITS_LESS) if growth < _FALLING else (_CLEAR, _FITS)
    if growth > _EVEN or _contrast(problem) < least:
        return ""
    psfs = dataclasses.replace(model, psfs=_light(np.asarray(model.psfs)))
    limit = most * _objective(problem)
    for one in (recording, dataclasses.replace(recording, imaging_model=psfs)):
        if _objective(_decoded(one.problem())) < limit:
            return CODES
    return ""


def _contrast(problem: InverseProblem) -> float:
    """The least standard deviation of a capture over its noise."""
    pairs = zip(problem.captures, problem.weights, strict=True)
    return min(float(np.std(np.asarray(c)) * np.max(np.asarray(w)) ** 0.5) for c, w in pairs)


def _objective(problem: InverseProblem) -> float:
    coarse, image, _ = coarsened(problem, start_image(problem, None), _COARSER)
    return AdmmTV().lowest_objective(coarse, image)


def _light(codes: np.ndarray) -> np.ndarray:
    most = max(float(codes.max()), 1e-30)
    return (most * np.maximum(codes / most, 0) ** _POWER).astype(codes.dtype)


def _decoded(problem: InverseProblem) -> InverseProblem:
    """The problem of decoded captures, with their noise."""
    captures = [jnp.asarray(_light(np.asarray(one))) for one in problem.captures]
    pairs = zip(problem.weights, captures, strict=True)
    valid = [jnp.broadcast_to(w > 0, c.shape) for w, c in pairs]
    before, after = (estimate_variance(list(c), valid) for c in (problem.captures, captures))
    weights = [w * n for w, n in zip(problem.weights, before / after, strict=True)]
    changed = tuple(captures), tuple(weights)
    return eqx.tree_at(lambda p: (p.captures, p.weights), problem, changed)
