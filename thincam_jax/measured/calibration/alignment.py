r"""Alignment of a display with a camera's object plane, by marks shown one at a time.

A small disc at r in the object's plane, at the distance t, casts the PSF h, blurred by the disc, at
s = −(d/t) r. Its shift is that of the least squares

.. math:: \min_{s, A, B} \sum_p [g(p) - B - A\,h(p - s)]^2

started at the peak of the matched filter; h is moved by the phase of its spectrum. The display's
place is the similarity or the homography that takes the marks, as shown, to where they are seen.
"""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from os import PathLike
from typing import Literal

import numpy as np
import scipy
import skimage
from jaxtyping import Float, UInt8

from thincam_jax._core.files import MeasurementError, read_json, write_whole
from thincam_jax._core.grids import block_mean

MapKind = Literal["similarity", "homography"]
Place = tuple[np.ndarray, np.ndarray]  # (x, y) and its covariance
_FOUND = 8.0  # standard errors of a mark's light; the highest peak of noise has near 5
_STEPS, _CONVERGED = 20, 1e-3  # of Gauss-Newton; pixels
_SAMPLING = 0.01  # pixels by which the sampling of a PSF moves a mark
_PARTS = 3  # of each of the display's pixels, along a side, in a picture


def locate_mark(
    frame: Float[np.ndarray, "y x"], psf: Float[np.ndarray, "v u"], radius: float = 0.0
) -> Place | None:
    """Shift (x, y) of the PSF in a frame of one mark, pixels; None where noise hides it.

    - `psf`: PSF of a point on the axis; the even number of pixels by which it is wider than the
      frame is the range of the search, half of it on each side.
    - `radius`: radius of the mark's image, pixels; 0 for a point.

    The covariance is White's, which needs not know the noise, and that of the sampling.
    """
    margin = [(wide - n) // 2 for wide, n in zip(psf.shape, frame.shape, strict=True)]
    inner = tuple(slice(m, m + n) for m, n in zip(margin, frame.shape, strict=True))
    y, x = np.fft.fftfreq(psf.shape[0])[:, None], np.fft.rfftfreq(psf.shape[1])
    q = 2 * np.pi * radius * np.hypot(y, x) + 1e-9
    spectrum = np.fft.rfft2(psf) * 2 * scipy.special.j1(q) / q
    blurred, level = np.fft.irfft2(spectrum, psf.shape), frame - frame.mean()
    score = skimage.feature.match_template(blurred, level)
    peak = np.unravel_index(np.argmax(score), score.shape)
    shift = np.subtract(margin, peak)[::-1].astype(float)
    for _ in range(_STEPS):
        moved = spectrum * np.exp(-2j * np.pi * (shift[0] * x + shift[1] * y))
        slopes = (-2j * np.pi * frequency * moved for frequency in (x, y))
        parts = [np.fft.irfft2(part, psf.shape)[inner].ravel() for part in (moved, *slopes)]
        design = np.stack([*parts, np.ones(frame.size)], axis=1)
        known = np.linalg.pinv(design.T @ design, hermitian=True)
        found = known @ (design.T @ level.ravel())
        left = level.ravel() - design @ found
        if not found[0] > _FOUND * math.sqrt(known[0, 0] * np.mean(left**2)):
            return None
        step = np.clip(found[1:3] / found[0], -1, 1)
        shift = shift + step
        if np.abs(step).max() < _CONVERGED:
            scores = design * left[:, None]
            covariance = (known @ (scores.T @ scores) @ known)[1:3, 1:3] / found[0] ** 2
            return shift, covariance + _SAMPLING**2 * np.eye(2)
    return None


@dataclass(frozen=True, eq=False)
class Alignment:
    """Place of a display's pixels on the object's plane, as `fit_alignment` finds it.

    - `shape`, `pitch`: number (rows, columns) and pitch (mm) of the display's pixels.
    - `unknowns`, `covariance`: parameters and their covariance, of a similarity a, b, x, y, for (x
      + a u − b v, y + b u + a v); of a homography its first eight entries, row by row. u, v: mm
      from the display's middle.
    - `marks`, `used`: number of marks shown, and of those that agree with the map.
    - `residual`: root mean square distance of these from the map, mm.
    """

    shape: tuple[int, int]
    pitch: float
    unknowns: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n n"]
    marks: int
    used: int
    residual: float

    def __call__(self, shown: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "point 2"]:
        """Places on the object's plane, mm, of places on the display, mm from its middle."""
        return _mapped(self.unknowns, shown)

    def errors(self, shown: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "point 2"]:
        """Standard errors of such places, mm."""
        return self._errors(lambda unknowns: _mapped(unknowns, shown))

    def _errors(self, function: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        steps = np.diag(np.sqrt(np.diag(self.covariance)))
        ends = [[function(self.unknowns + s * step) for step in steps] for s in (0.5, -0.5)]
        slopes = np.subtract(ends[0], ends[1])  # over one standard error each
        correlation = self.covariance / np.outer(steps.sum(0), steps.sum(0))
        return np.sqrt(np.einsum("i...,ij,j...->...", slopes, correlation, slopes))

    def summary(self) -> dict[str, float]:
        """Offset (mm), rotation (rad, clockwise as seen) and scale at the display's middle, with
        standard errors; residual in mm and in pixels of the display; marks that agree."""
        found, errors = _at_middle(self.unknowns), self._errors(_at_middle)
        names = ("offset_x", "offset_y", "rotation", "scale")
        values = dict(zip(names, found.tolist(), strict=True))
        values |= {f"{n}_error": e for n, e in zip(names, errors.tolist(), strict=True)}
        pixels = self.residual / (values["scale"] * self.pitch)
        return values | {"residual": self.residual, "residual_pixels": pixels, "used": self.used}

    def __str__(self) -> str:
        pixels = self.summary()["residual_pixels"]
        kept = f"{self.used} of {self.marks} marks lie within {self.residual:.2g} mm"
        return f"{kept}, {pixels:.2g} pixels of the display, rms."

    def place(self, levels: UInt8[np.ndarray, "row column"], width: float) -> np.ndarray:
        """Levels of the display, uint8, that show a picture about the object plane's middle.

        - `width`: width of the picture on the object's plane, mm.
        """
        fine = _PARTS * self.shape[0], _PARTS * self.shape[1]
        to_cell = to_indices(levels.shape, width / levels.shape[1]) @ _matrix(self.unknowns)
        inverse = to_cell @ np.linalg.inv(to_indices(fine, self.pitch / _PARTS))
        shown = skimage.transform.warp(levels / 255, inverse, output_shape=fine, order=0)
        return np.rint(255 * block_mean(shown, _PARTS)).astype(np.uint8)

    def save(self, path: str | PathLike[str]) -> None:
        """Write a JSON file."""
        arrays = {name: getattr(self, name).tolist() for name in ("unknowns", "covariance")}
        write_whole(path, json.dumps(asdict(self) | arrays, indent=1) + "\n")

    @classmethod
    def load(cls, path: str | PathLike[str]) -> "Alignment":
        """Read such a file; ValueError, one line, for another one."""
        try:
            given = read_json(path)
            arrays = {name: np.array(given[name], float) for name in ("unknowns", "covariance")}
            found = cls(**given | arrays | {"shape": tuple(given["shape"])})
            found.summary()
            return found
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path} holds no alignment of a display: {error}") from error


def fit_alignment(
    display: tuple[tuple[int, int], float],
    shown: Float[np.ndarray, "mark 2"],
    seen: Sequence[Place | None],
    kind: MapKind,
    limit: float,
) -> Alignment:
    """Fit the map to marks, without those that do not agree with it (RANSAC).

    - `display`: shape and pitch, mm, of its pixels.
    - `shown`: places (x, y) on the display, mm from its middle.
    - `seen`: places on the object's plane, mm; None for a mark that was not found.
    - `limit`: mm by which a mark may miss the map.

    The errors follow from those of the marks; larger residuals enlarge them.

    **Errors**: MeasurementError, one line, where no more marks agree than determine the map.
    """
    name, least = ("Similarity", 2) if kind == "similarity" else ("Projective", 4)
    form = getattr(skimage.transform, f"{name}Transform")
    there = np.array([one is not None for one in seen])
    places, covariance = (np.array([one[k] for one in seen if one is not None]) for k in (0, 1))
    first, agree, used = None, None, 0
    if len(places) > least:
        given = {"min_samples": least, "residual_threshold": limit, "max_trials": 1000, "rng": 0}
        first, agree = skimage.measure.ransac((shown[there], places), form, **given)
        used = 0 if agree is None else int(np.count_nonzero(agree))
    if first is None or used <= least:
        raise MeasurementError(
            f"{len(places)} of {len(seen)} marks were found and {used} lie within {limit:.3g} mm "
            f"of a {kind}, which takes {least + 1}; expose longer, show larger marks inside the "
            "field, or check the mask and the distances"
        )
    shown, places = shown[there][agree], places[agree]
    whiten = np.linalg.inv(np.linalg.cholesky(covariance[agree]))

    def residual(unknowns: np.ndarray) -> np.ndarray:
        return np.einsum("mij,mj->mi", whiten, _mapped(unknowns, shown) - places).ravel()

    entries = (first.params / first.params[2, 2]).ravel()[:8]
    start = entries[[0, 3, 2, 5]] if kind == "similarity" else entries
    solved = scipy.optimize.least_squares(residual, start, jac="3-point", x_scale="jac")
    excess = 2 * solved.cost / (2 * used - len(start))
    known = np.linalg.inv(solved.jac.T @ solved.jac) * max(1.0, excess)
    rms = float(np.linalg.norm(_mapped(solved.x, shown) - places) / math.sqrt(used))
    return Alignment(*display, solved.x, known, len(seen), used, rms)


def _matrix(unknowns: np.ndarray) -> Float[np.ndarray, "3 3"]:
    if len(unknowns) == 8:
        return np.append(unknowns, 1.0).reshape(3, 3)
    a, b, x, y = unknowns
    return np.array([[a, -b, x], [b, a, y], [0, 0, 1]])


def _mapped(unknowns: np.ndarray, points: np.ndarray) -> np.ndarray:
    return skimage.transform.ProjectiveTransform(_matrix(unknowns))(points)


def _at_middle(unknowns: np.ndarray) -> np.ndarray:
    """Offset x, y, rotation and scale of the linear part at the display's middle."""
    (a, b, x), (c, d, y), (p, q, _) = _matrix(unknowns)
    a, b, c, d = a - x * p, b - x * q, c - y * p, d - y * q
    return np.array([x, y, math.atan2(c - b, a + d), math.sqrt(abs(a * d - b * c))])


def to_indices(shape: tuple[int, int], pitch: float = 1.0) -> Float[np.ndarray, "3 3"]:
    """Matrix from places (x, y) about the middle to indices (column, row) of samples of a pitch."""
    rows, columns = shape
    return np.array([[1 / pitch, 0, (columns - 1) / 2], [0, 1 / pitch, (rows - 1) / 2], [0, 0, 1]])
