"""Agreement of images with their truths: how levels and places are fitted, and means over images.

In light, not in codes, as everywhere in this package. Eager NumPy.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy.stats
from jaxtyping import Float32, Float64

from thincam_jax._core.table import Cell, Table, number
from thincam_jax.imaging.encoding import as_picture
from thincam_jax.imaging.metrics import psnr, ssim
from thincam_jax.imaging.metrics.image import fit_levels
from thincam_jax.studies.intervals import PixelSample, cross_validated

Fit = Literal["levels", "gain", "maximum", "none"]
FITS: dict[Fit, str] = {
    "levels": "a gain and an offset for each channel bring the image closest to the truth, in "
    "least squares",
    "gain": "a gain for each channel brings the image closest to the truth, in least squares",
    "maximum": "image and truth are divided by their maxima, as in LenslessPiCam",
    "none": "the image is taken as it is",
}


@dataclass(frozen=True, eq=False)
class Agreement:
    """Scores of an image, and the image (channel, y, x) as it was compared, with its truth.

    - `psnr_db`: None of equal images. `ssim`: None of images smaller than its window.
    - `gain`, `offset`: numbers fitted to each channel; `shift`: move in pixels, down and right.
    """

    psnr_db: float | None
    ssim: float | None
    gain: tuple[float, ...]
    offset: tuple[float, ...]
    shift: tuple[int, int]
    image: Float32[np.ndarray, "channel y x"]
    truth: Float32[np.ndarray, "channel y x"]


def agreement(
    image: Float32[np.ndarray, "channel y x"],
    truth: Float32[np.ndarray, "channel y x"],
    fit: Fit = "levels",
    shift: int = 0,
) -> Agreement:
    """Compare an image with its truth, light of 0 to 1 on the same pixels.

    - `fit`: one of `FITS`. `shift`: most pixels by which the image is moved to where it correlates
      best; so many are then left out along the border, whatever the move.

    PSNR = 10 log₁₀(1/mean((image − truth)²)), and SSIM over windows of 7 by 7 pixels
    (`tc.imaging.metrics`), over all channels.

    **Errors**: ValueError for other shapes, or a shift that leaves nothing.

    ```python
    import numpy as np
    from thincam_jax.studies.agreement import agreement

    truth = np.random.default_rng(0).uniform(size=(3, 20, 24)).astype(np.float32)
    found = agreement(np.roll(0.5 * truth + 0.1, 2, axis=2), truth, shift=3)
    print(found.shift, found.gain[0].round(2), found.psnr_db > 100)  # (0, -2) 2.0 True
    ```
    """
    if image.shape != truth.shape or min(truth.shape[1:]) <= 2 * shift or shift < 0:
        raise ValueError(
            f"image {image.shape}, truth {truth.shape}, shift {shift}: give equal shapes, larger "
            "than twice the shift"
        )
    move = _best_shift(image, truth, shift)
    inner = (slice(None), *(slice(shift, n - shift) for n in truth.shape[1:]))
    truth, image = truth[inner], _moved(image, move, shift)
    pair = as_picture(image), as_picture(truth)
    ones = np.ones(len(image))
    gain, offset = ones, 0 * ones
    if fit == "levels":
        _, gain, offset = fit_levels(*pair)
    elif fit == "gain":
        power = np.sum(image.astype(float) ** 2, axis=(1, 2))
        gain = np.sum(image * truth, axis=(1, 2), dtype=float) / np.maximum(power, 1e-30)
    elif fit == "maximum":
        gain = ones / max(float(image.max()), 1e-30)
        truth = truth / max(float(truth.max()), 1e-30)
    gain, offset = np.atleast_1d(gain), np.atleast_1d(offset)
    shown = image * gain[:, None, None] + offset[:, None, None]
    pair = as_picture(shown), as_picture(truth)
    value = psnr(*pair, aligned=False)
    similar = ssim(*pair, aligned=False) if min(truth.shape[1:]) >= 7 else None
    numbers = tuple(gain.tolist()), tuple(offset.tolist()), move
    compared = shown.astype(np.float32), truth.astype(np.float32)
    return Agreement(value if math.isfinite(value) else None, similar, *numbers, *compared)


def _moved(image: np.ndarray, move: tuple[int, int], border: int) -> np.ndarray:
    """The part of an image within a border, after a move."""
    begins = zip(move, image.shape[1:], strict=True)
    rows, columns = (slice(border - d, n - border - d) for d, n in begins)
    return image[:, rows, columns]


def _best_shift(image: np.ndarray, truth: np.ndarray, most: int) -> tuple[int, int]:
    """Move of the image by which it correlates best with the truth, within a border."""
    inner = truth[(slice(None), *(slice(most, n - most) for n in truth.shape[1:]))].mean(axis=0)
    reference, grey = inner - inner.mean(), image.mean(axis=0, keepdims=True)
    best, place = -np.inf, (0, 0)
    # From the middle outwards, so that of equal moves the least is taken.
    for move in sorted(np.ndindex(2 * most + 1, 2 * most + 1), key=lambda m: _far(m, most)):
        here = move[0] - most, move[1] - most
        part = _moved(grey, here, most)[0]
        part = part - part.mean()
        score = float(np.sum(part * reference)) / max(float(np.linalg.norm(part)), 1e-30)
        if score > best * (1 + 1e-6) or best == -np.inf:
            best, place = score, here
    return place


def _far(move: tuple[int, ...], most: int) -> int:
    return sum((n - most) ** 2 for n in move)


@dataclass(frozen=True)
class Mean:
    """Mean over images, and half of its interval of 95 %, by Student's t; None of one image."""

    mean: float
    half: float | None

    def words(self, digits: int = 2) -> str:
        """Such as 21.43 ± 0.55."""
        return " ± ".join(number(n, digits) for n in (self.mean, self.half) if n is not None)


def mean_of(values: Sequence[float | None]) -> Mean | None:
    """Mean of the numbers among the values; None without any."""
    known = np.asarray([value for value in values if value is not None], float)
    if len(known) < 2:
        return Mean(float(known[0]), None) if len(known) else None
    return Mean(float(known.mean()), half_interval(known))


def half_interval(values: Float64[np.ndarray, " n"]) -> float:
    """Half of the interval of 95 % of the mean of two values or more, by Student's t."""
    error = float(np.std(values, ddof=1)) / len(values) ** 0.5
    return float(scipy.stats.t.ppf(0.975, len(values) - 1)) * error


@dataclass(frozen=True)
class MethodSummary:
    """Scores of a method over the images of a data set.

    - `beside`: PSNR less that of the first method in the same images. `seconds`: median.
    - `failed`: images that could not be reconstructed. `worst`, `median`, `best`: PSNR, dB.
    - `covered`, `width`: share of the truth's pixels in intervals of 90 % that other images
      calibrated, and mean width of these; see `studies.intervals` for their unit.
    """

    method: str
    images: int
    failed: int
    psnr_db: Mean | None
    beside: Mean | None
    worst: float | None
    median: float | None
    best: float | None
    ssim: Mean | None
    residual: Mean | None
    seconds: float | None
    covered: Mean | None = None
    width: Mean | None = None


def summarised(
    rows: Sequence[Mapping[str, Any]], failed: Mapping[str, int]
) -> tuple[MethodSummary, ...]:
    """Scores of each method of a table's rows, in order; `failed`: images of methods without."""
    methods = list(dict.fromkeys([row["method"] for row in rows] + list(failed)))
    by_method = {m: {r["number"]: r for r in rows if r["method"] == m} for m in methods}
    found: list[MethodSummary] = []
    for method, own in by_method.items():
        first = by_method[methods[0]]
        psnrs = [row["psnr_db"] for row in own.values() if row["psnr_db"] is not None]
        common = [(own[n]["psnr_db"], first[n]["psnr_db"]) for n in own if n in first]
        gains = [a - b for a, b in common if a is not None and b is not None]
        worst = median = best = None
        if psnrs:
            worst, median, best = min(psnrs), float(np.median(psnrs)), max(psnrs)
        similar, left = (mean_of([r[n] for r in own.values()]) for n in ("ssim", "residual"))
        seconds = float(np.median([row["seconds"] for row in own.values()])) if own else None
        beside = None if method == methods[0] else mean_of(gains)
        counts = len(own), failed.get(method, 0)
        held = [mean_of(one) for one in cross_validated(PixelSample.of_rows(own.values()))]
        scores = mean_of(psnrs), beside, worst, median, best, similar, left, seconds, *held
        found.append(MethodSummary(method, *counts, *scores))
    return tuple(found)


def scores_table(scores: Sequence[MethodSummary], brief: bool = False) -> Table:
    """The scores of methods, one a row; a `brief` table fits a terminal."""
    columns: dict[str, tuple[int, list[Cell]]] = {
        "method": (0, [one.method.replace("_", "-") for one in scores]),
        "images": (0, [one.images for one in scores]),
        "failed": (0, [one.failed for one in scores]),
        "PSNR, dB": (0, [one.psnr_db and one.psnr_db.words() for one in scores]),
        "beside\nthe first": (0, [one.beside and one.beside.words() for one in scores]),
        "worst": (2, [one.worst for one in scores]),
        "median": (2, [one.median for one in scores]),
        "best": (2, [one.best for one in scores]),
        "SSIM": (
            3,
            [one.ssim and (one.ssim.mean if brief else one.ssim.words(3)) for one in scores],
        ),
        "residual": (4, [one.residual and one.residual.mean for one in scores]),
        "seconds": (2, [one.seconds for one in scores]),
        "in intervals\nof 90 %": (3, [one.covered and one.covered.words(3) for one in scores]),
        "their\nwidth": (3, [one.width and one.width.words(3) for one in scores]),
    }
    unknown = ("in intervals\nof 90 %", "their\nwidth")
    left_out = ("beside\nthe first",) if len(scores) == 1 else ()
    left_out += () if any(one.covered for one in scores) else unknown
    for name in {*left_out, *(("images", "failed", "median", "best", *unknown) if brief else ())}:
        del columns[name]
    digits, cells = zip(*columns.values(), strict=True)
    return Table(tuple(columns), list(zip(*cells, strict=True)), digits=digits[1:])
