"""Whether captures fit PSFs better that are mirrored or of another size.

A wrong PSF explains a capture nearly as well as the right one, by an image full of artefacts; the
objective, which counts these too, is 1.2 to 10 times that of the right one. It is compared on
pixels four times as large.
"""

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Complex

from thincam_jax.reconstruction.coarse import coarsened
from thincam_jax.reconstruction.problem import InverseProblem, convolutions
from thincam_jax.reconstruction.psf_check import scaled_psf
from thincam_jax.reconstruction.regularisers import Image

TURN = "turn the PSF or the captures"
RESIZE = "refine it (thincam calibrate check --refine), or the cameras' distance"
_FIT = "the captures fit far better a PSF that"
MIRRORED = {"upside down": (-2,), "mirrored left to right": (-1,), "turned by 180°": (-2, -1)}
_SCALES = (0.94, 0.97, 1.03, 1.06)
_COARSER = 2  # times twice as large
_BETTER = 0.85  # of the objective
_LARGEST = 256  # pixels of the shorter side that are solved for this


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
    if operators is None or min(problem.field_shape) > _LARGEST:
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
