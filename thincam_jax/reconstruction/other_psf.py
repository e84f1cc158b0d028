"""Whether captures fit PSFs better that are mirrored or of another size, or are negatives.

A wrong PSF explains a capture nearly as well as the right one, by an image full of artefacts; the
objective, which counts these too, is 1.2 to 10 times that of the right one. It is compared on
pixels four times as large. So is that of the inverted captures.
"""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex

from thincam_jax._core.checks import holds_traced
from thincam_jax.reconstruction.backgrounds import light_of_uniform, with_other_background
from thincam_jax.reconstruction.coarse import coarsened, finer
from thincam_jax.reconstruction.iterate import Outcome
from thincam_jax.reconstruction.noise import details_by_light
from thincam_jax.reconstruction.problem import InverseProblem, convolutions, detector_shape
from thincam_jax.reconstruction.psf_check import scaled_psf
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.smooth_misfit import misfit_of

TURN = "turn the PSF or the captures"
RESIZE = "refine it (--refine, in Python tc.refine), or the cameras' distance"
_FIT = "the captures fit far better a PSF that"
MIRRORED = {"upside down": (-2,), "mirrored left to right": (-1,), "turned by 180°": (-2, -1)}
NEGATIVE = "the captures fit far better inverted; give full scale minus captures, as 255 - captures"
_SCALES = (0.94, 0.97, 1.03, 1.06)
_COARSER = 2  # times twice as large
_BETTER = 0.85  # of the objective
_FAR_BETTER = 0.5  # of the objective, where noise that falls does not tell of inversion
LARGEST = 256  # pixels of the shorter side that are solved for this
# Iterations that tell of an objective, and the residual over the noise that inverted captures leave
# at most: 1.0 to 1.3, those of a wrong PSF 1.5 and more.
_ENOUGH, _EXPLAINED = 40, 1.4
_AGAINST = -0.5  # correlation with the light of a uniform scene
_GROWS, _FALLS = 1.15, 0.85  # noise where it is bright over that where it is dark


def better_psf(
    problem: InverseProblem,
    image: Image,
    solve: Callable[[InverseProblem, Image], float],
    of_any_size: bool = True,
) -> str:
    """A sentence where the captures agree far better with changed PSFs, else nothing.

    - `solve`: the lowest objective of a problem, from a start image.
    - `of_any_size`: whether other sizes are tried. Smooth light that nothing explains, such as a
      scene beyond the field, fits a smaller PSF better, too.
    """
    problem, image, _ = coarsened(problem, image, _COARSER)
    operators = convolutions(problem)
    if operators is None or min(problem.field_shape) > LARGEST:
        return ""

    def objective(change) -> float:
        spectra = [
            change(np.asarray(o.spectrum), o.window).astype(o.spectrum.dtype) for o in operators
        ]
        changed = [
            eqx.tree_at(lambda o: o.spectrum, *p) for p in zip(operators, spectra, strict=True)
        ]
        return solve(eqx.tree_at(lambda p: p.operators, problem, tuple(changed)), image)

    found = {f"is {name}; {TURN}": objective(_mirror(axes)) for name, axes in MIRRORED.items()}
    if of_any_size:
        found |= {f"has {s:g} times the size; {RESIZE}": objective(_resize(s)) for s in _SCALES}
    best = min(found, key=lambda name: found[name])
    is_better = found[best] < _BETTER * solve(problem, image)
    return f"{_FIT} {best}" if is_better else ""


def negative_captures(
    problem: InverseProblem,
    coarse: InverseProblem,
    image: Image,
    outcome: Outcome,
    start: Callable[[InverseProblem, Image], Outcome],
    finish: Callable[[InverseProblem, Image], Outcome],
) -> str:
    """A sentence where inverted captures fit far better, and to the noise, else nothing.

    - `coarse`: the problem on larger pixels, with its start `image` and `outcome`.
    - `start`: solver of such a problem. `finish`: solver on all pixels, from an image.
    """
    is_sure = outcome.status in ("converged", "iterations_exhausted")
    if not is_sure or outcome.iterations < _ENOUGH or (share := _inverse_share(problem)) is None:
        return ""
    found = start(inverted(coarse), image)
    lowest = found.history[-1].objective if found.history else math.inf
    if lowest > share * outcome.history[-1].objective:
        return ""
    whole = inverted(problem)
    found = finish(whole, finer(found.image, problem.field_shape))
    misfit = misfit_of(whole, found.image)
    return NEGATIVE if misfit is not None and misfit.whole < _EXPLAINED else ""


def negative_behind_operators(recording: Recording) -> str:
    """A sentence where captures are dark where a uniform scene is bright, else nothing.

    The correlation of both, beside a background, was above −0.35 in upright captures of points,
    lines and photographs behind separable and dense cameras, and 0.5 to 1 of photographs. It is not
    looked at with PSFs, and where a uniform scene casts a uniform capture.
    """
    operators = getattr(recording.imaging_model, "operators", ())
    if not operators or holds_traced((operators, recording.captures)):
        return ""
    if any(len(detector_shape(operator)) != 2 for operator in operators):
        return ""
    weights = [jnp.ones(()) if m is None else m for m in recording.valid or [None] * len(operators)]
    found = jax.device_get(light_of_uniform(operators, recording.light, weights))
    return NEGATIVE if max(map(float, found)) < _AGAINST else ""


def _inverse_share(problem: InverseProblem) -> float | None:
    """Below what share of the objective inverted captures are right.

    A negative of the image explains a negative to the noise, but its variation is larger. Where
    the noise grows with the light, as that of photons does, captures are none: the result is None,
    as it is for operators that are no convolutions, and for several planes.
    """
    if convolutions(problem) is None or problem.image_shape[-3] > 1:
        return None
    growth = noise_growth(problem)
    return None if growth > _GROWS else 1.0 if growth < _FALLS else _FAR_BETTER


def inverted(problem: InverseProblem) -> InverseProblem:
    """The problem of the inverted captures, with a background to find."""
    captures = []
    for capture, weight in zip(problem.captures, problem.weights, strict=True):
        light, known = np.asarray(capture), np.asarray(weight) > 0  # no program to compile
        high, low = (
            one(np.where(known, light, end), axis=(-2, -1), keepdims=True)
            for one, end in ((np.max, -np.inf), (np.min, np.inf))
        )
        captures.append(jnp.asarray(2 * high - low - light))  # that is not negative
    problem = eqx.tree_at(lambda p: p.captures, problem, tuple(captures))
    return problem if problem.has_background else with_other_background(problem, "unknown")


def noise_growth(problem: InverseProblem) -> float:
    """Median detail of the brightest quarter of the captures' pixels over that of the darkest."""
    found = []
    for capture, weight in zip(problem.captures, problem.weights, strict=True):
        shape = -1, *capture.shape[-2:]
        known = np.broadcast_to(np.asarray(weight) > 0, capture.shape).reshape(shape)
        for plane, good in zip(np.asarray(capture).reshape(shape), known, strict=True):
            good = good & (plane > plane.min()) & (plane < plane.max())
            _, detail = details_by_light(plane, good)
            quarter = detail.size // 4
            if quarter:
                dark, bright = np.median(detail[:quarter]), np.median(detail[-quarter:])
                found.append(float(bright / dark) if dark > 0 else np.inf)
    return float(np.median(found)) if found else np.inf


def without_size(reason: str) -> str:
    """A reason without the sentence that a PSF of another size fits better."""
    return reason.partition(_FIT)[0].rstrip("; ") if reason.endswith(RESIZE) else reason


def _mirror(axes: tuple[int, ...]):
    """The spectrum of a mirrored kernel; of a real one that is mirrored along both, conjugate."""

    def change(spectrum: Complex[np.ndarray, "*kernel v u"], _) -> np.ndarray:
        if len(axes) == 2:
            return np.conj(spectrum)
        turned = np.roll(np.flip(spectrum, -2), 1, -2)
        return turned if axes == (-2,) else np.conj(turned)

    return change


def _resize(scale: float):
    def change(spectrum: Complex[np.ndarray, "*kernel v u"], window: tuple[int, int]) -> np.ndarray:
        kernel = np.fft.fftshift(np.fft.irfft2(spectrum, s=window), axes=(-2, -1))
        return np.fft.rfft2(np.fft.ifftshift(scaled_psf(kernel, scale), axes=(-2, -1)))

    return change
