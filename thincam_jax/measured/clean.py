"""Setting the noise of a measured PSF to zero, and moving the PSF to the middle."""

import math
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float

from thincam_jax.measured.options import Centre


def clean(
    psf: Float[np.ndarray, "channel y x"],
    noise: Float[np.ndarray, "#channel"],
    threshold: float | int | None = None,
    noise_threshold: float | int | None = None,
) -> tuple[Float[np.ndarray, "channel y x"], dict[str, Any]]:
    """The PSF with its small values set to zero, and a record of what that removed.

    Below `threshold` parts of each channel's maximum or `noise_threshold` times its `noise`,
    whichever is larger. Noise left in a PSF acts as a haze over the reconstruction; but what is
    removed of the PSF's own faint light is missing too.
    """
    levels = np.zeros(psf.shape[0])
    if threshold is not None:
        levels = np.maximum(levels, threshold * psf.max(axis=(1, 2)))
    if noise_threshold is not None:
        levels = np.maximum(levels, noise_threshold * noise)
    small = psf < levels[:, None, None]
    kept = np.where(small, psf.dtype.type(0), psf)
    light = float(psf.sum(dtype=np.float64))
    return kept, {
        "threshold": threshold,
        "noise_threshold": noise_threshold,
        "level": levels.tolist(),
        "zeroed": int(np.count_nonzero(small & (psf > 0))),
        "light_removed": 1 - float(kept.sum(dtype=np.float64)) / light if light > 0 else 0.0,
    }


def centre_psf(
    psf: Float[np.ndarray, "channel y x"], by: Centre
) -> tuple[Float[np.ndarray, "channel y x"], dict[str, Any]]:
    """The PSF shifted by whole pixels to the middle of its array, and a record of the shift.

    `by` is one of "centroid", "peak", "symmetry" (see `Preparation.centre`), of the sum of the
    channels; all are shifted alike. What leaves the array is lost, what enters is 0.
    """
    found = _centre(psf.sum(axis=0, dtype=np.float64), by)
    sides = zip(psf.shape[1:], found, strict=True)
    # Rounded up at a half, so that a single bright pixel comes to n//2, the origin of a DFT.
    rows, columns = (math.floor((n - 1) / 2 - c + 0.5) for n, c in sides)
    moved = _shift(psf, rows, columns)
    light = float(psf.sum(dtype=np.float64))
    return moved, {
        "by": by,
        "found": [float(c) for c in found],
        "shift": [rows, columns],
        "light_lost": 1 - float(moved.sum(dtype=np.float64)) / light if light > 0 else 0.0,
    }


def _centre(image: np.ndarray, by: Centre) -> tuple[float, float]:
    """Row and column, in pixels from the first, maybe between two."""
    if by == "centroid":
        total = image.sum()
        if not total > 0:
            return (image.shape[0] - 1) / 2, (image.shape[1] - 1) / 2
        row = image.sum(axis=1) @ np.arange(image.shape[0]) / total
        column = image.sum(axis=0) @ np.arange(image.shape[1]) / total
        return float(row), float(column)
    scores, scale = image, 1
    if by == "symmetry":
        # Σ p(c + r) p(c − r) is largest for the centre c that maps the image best onto itself.
        scores, scale = scipy.signal.fftconvolve(image, image), 2
    row, column = np.unravel_index(np.argmax(scores), scores.shape)
    return int(row) / scale, int(column) / scale


def _shift(image: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Zeros come in where pixels leave."""
    moved = np.zeros_like(image)
    target = _overlap(image.shape[1], rows), _overlap(image.shape[2], columns)
    source = _overlap(image.shape[1], -rows), _overlap(image.shape[2], -columns)
    moved[:, *target] = image[:, *source]
    return moved


def _overlap(count: int, shift: int) -> slice:
    return slice(max(shift, 0), count + min(shift, 0))
