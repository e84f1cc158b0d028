"""Examination of captures and a PSF as they came in: values in them that measure no light."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from jaxtyping import Bool, Float

from thincam_jax._core.arguments import checked
from thincam_jax._core.grids import block_mean, central_blocks
from thincam_jax.imaging.defects import defects, fine_noise, plateau, stuck
from thincam_jax.measured.options import Preparation
from thincam_jax.measured.raw import Raw, with_dead

_DIM, _LIT, _SATURATED, _BORDER, _COLOURED = 2.0, 25.0, 5.0, 10.0, 3.0  # %
_TILES, _COARSE = 8, 64
_FLAT, _MANY = 0.1, 0.1  # of a PSF's bright pixels, and of all
# Unit and consequence, and what mends it.
_TEXTS = {
    "plateau": "% of the pixels have the largest value, {}, and are not used; give {} to say so",
    "flat": "% of the pixels have the largest value, {}, where the light is cut off; expose less",
    "defective": "hot or dead pixels are not used; give a map of them with --dead",
    "replaced": "hot or dead pixels are filled by their neighbours; subtract a dark frame",
    "unknown": "pixels without a value, rows {}, columns {}, are filled by their neighbours; "
    "measure the PSF again there",
    "mosaic": "% is the step between pixels, as of a colour sensor, which shows; give --bayer {}",
    "no mosaic": "% is the step between pixels, not as of a colour sensor; leave --bayer out",
    "overexposed": "% of the pixels are saturated: the image is a guess there; expose less",
    "underexposed": "% of full scale is the brightest part; expose longer, or give its --bits",
    "cut": "% of its peak varies along its border: what is beyond is missing; compute it: --camera",
    "size": "times the PSF's rows, and {:.3g} times its columns; give both equally binned, and "
    "turned alike, or --psf-scale",
    "swapped": "% is not explained by the PSF, which it explains; exchange --psf and --capture",
    "same": "% of the pixels are those of the PSF; give the capture of a scene, not of the point",
    "unexplained": "% of its variation is neither image nor noise; try thincam calibrate check",
    "misfit": "times the noise is left; {}",
    "noise": "counts of noise are found, and {} are given; leave --noise out if that is unsure",
}


@dataclass(frozen=True)
class Finding:
    """One fault of an image: its `number`, whose unit begins `consequence`, and what mends it."""

    name: str
    where: str
    number: float
    consequence: str
    advice: str
    severe: bool = False

    def __str__(self) -> str:
        return f"{self.where}: {self.number:.3g} {self.consequence}; {self.advice}"


def finding(
    name: str, where: str, number: float, severe: bool = False, *words: str | float
) -> Finding:
    """Finding of a kind in `_TEXTS`, filled with `words`."""
    consequence, _, advice = _TEXTS[name].format(*words).partition("; ")
    return Finding(name, where, float(number), consequence, advice, severe)


@dataclass(frozen=True, eq=False)
class Examination:
    """Findings, and the images: plateaus are saturation, defective pixels dead, or filled."""

    findings: tuple[Finding, ...]
    captures: tuple[Raw, ...]
    psf: Raw | None = None


@checked
def examine(
    captures: Sequence[Raw], psf: Raw | None = None, options: Preparation | None = None
) -> Examination:
    """Examine raw captures of one camera and their PSF for faults that decide the image.

    `options` of the preparation that follows: the Bayer pattern and the saturation.

    - plateau: many pixels share the largest value, and few each of the next lower ones.
    - defective: single pixels beyond all neighbours of their colour by a multiple of their range,
      without the blur of light, in most of the captures, in images without structure as fine;
      pixels at a lowest value that none comes near, and lines of one value.
    - unknown: NaN, masked or dead pixels of a PSF. Those of captures are not used, as by `Raw`.
    - mosaic: the means of the pixels of 2×2 differ, but not those of one diagonal, green.
    - exposure, and a PSF whose light varies along its border; a computed one is not examined.
    - size: a capture and its PSF have different sizes, and no `psf_scale`.
    - swapped: the capture as PSF explains the PSF as capture, and not the reverse; same: both are
      one image.
    """
    options = options or Preparation()
    is_measured = psf is not None and psf.sensor_shape is None
    images, count = [*captures, psf] if is_measured else [*captures], len(captures)
    findings: list[Finding] = []
    maps = [defective_pixels(raw, _mosaic(raw, options)) for raw in images]
    for n, odd in enumerate(maps):
        is_psf, raw = n == count, images[n]
        where = f"{'PSF' if is_psf else 'capture'} {raw.name}"
        if is_psf and raw.dead is not None and raw.dead.any():
            spans = [np.flatnonzero(raw.dead.any(axis=axis))[[0, -1]] for axis in (1, 0)]
            words = (f"{first} to {last}" for first, last in spans)
            is_severe = bool(raw.dead.mean() > _MANY)
            findings.append(finding("unknown", where, float(raw.dead.sum()), is_severe, *words))
        if is_psf and odd.any():
            findings.append(finding("replaced", where, float(odd.sum())))
            raw = with_dead(raw, odd)
        images[n] = raw = _examined(raw, where, options, findings)
        same = [one for one in maps[:count] if one.shape == odd.shape]
        if not is_psf and (odd := odd & (2 * np.sum(same, axis=0) > len(same))).any():
            findings.append(finding("defective", where, float(odd.sum())))
            images[n] = with_dead(raw, odd)
    if is_measured and captures and images[0].pixels.shape[:2] == images[-1].pixels.shape[:2]:
        left, other = _unexplained(images[-1], images[0]), _unexplained(images[0], images[-1])
        if np.array_equal(images[0].pixels, images[-1].pixels):
            findings.append(finding("same", f"capture {images[0].name}", 100.0, True))
        elif 0 < other < left / 2:
            findings.append(finding("swapped", f"capture {images[0].name}", 100 * left, True))
    for raw in images[:count] if is_measured and options.psf_scale is None else ():
        rows, columns = np.divide(raw.pixels.shape[:2], images[-1].pixels.shape[:2])
        if (rows, columns) != (1, 1):
            findings.append(finding("size", f"capture {raw.name}", rows, True, columns))
    return Examination(tuple(findings), tuple(images[:count]), images[-1] if is_measured else psf)


def defective_pixels(raw: Raw, is_mosaic: bool = False) -> Bool[np.ndarray, "y x"]:
    """Map of pixels and lines that differ from all neighbours of their colour as no light does."""
    found = np.zeros(raw.pixels.shape[:2], bool)
    for part in _phases(is_mosaic):
        planes = np.atleast_3d(raw.pixels[part]).astype(np.float32)
        for plane in np.moveaxis(planes, -1, 0):
            step = float(raw.pixels.dtype.kind == "u")
            found[part] |= defects(plane, step) | stuck(plane, step)
    return found if raw.dead is None else found & ~raw.dead


def _phases(is_mosaic: bool) -> list[tuple[slice, slice]]:
    step = 2 if is_mosaic else 1
    return [np.s_[i::step, j::step] for i in range(step) for j in range(step)]


def _mosaic(raw: Raw, options: Preparation) -> bool:
    return raw.pixels.ndim == 2 and (options.bayer or raw.bayer) is not None


def _grey(raw: Raw) -> Float[np.ndarray, "y x"]:
    return np.atleast_3d(raw.pixels).mean(axis=2, dtype=np.float32)


def _examined(raw: Raw, where: str, options: Preparation, found: list[Finding]) -> Raw:
    """An image with its plateau as saturation; what histogram and colours say is added."""
    is_psf, image, is_mosaic = where.startswith("PSF"), _grey(raw), _mosaic(raw, options)
    full, top, count = raw.full_scale, float(raw.pixels.max()), plateau(raw.pixels)
    level = full * (options.saturation or (1.0 if raw.bits else np.inf))
    is_unsaid = options.saturation is None and top < level
    if count and (is_unsaid or is_psf):
        bits = max(8, math.ceil(np.log2(top + 1)))  # of a camera
        given, most = ("", full) if 2**bits - 1 != top <= full else (f"--bits {bits}", 2**bits - 1)
        given += f" --saturation {0.99999 * top / most:.6f}" * (top < most or not given)
        share, words = 100 * count / raw.pixels.size, (f"{top:g}", given.strip())
        bright = np.count_nonzero(raw.pixels > (top + float(np.median(raw.pixels))) / 2)
        severe = bool(is_psf and count > _FLAT * bright)
        found.append(finding("flat" if is_psf else "plateau", where, share, severe, *words))
        level, raw = min(top, level), replace(raw, saturation=top) if is_unsaid else raw
    share = 100 * float(np.mean(raw.pixels >= level))
    if not is_psf and share > _SATURATED:
        found.append(finding("overexposed", where, share, share > 50))
    low, high = np.percentile(raw.pixels, [1, 99.9])
    bright = 100 * (high - (low if raw.black_level is None else raw.black_level)) / full
    if raw.bits is not None and bright < _DIM and not count and 100 * high < _LIT * full:
        found.append(finding("underexposed", where, bright))
    difference, error, pattern = _phase_difference(image)
    if raw.channels == 1 and pattern and not is_mosaic:
        found.append(finding("mosaic", where, difference, True, pattern))
    elif not is_psf and is_mosaic and difference + 3 * error < _COLOURED:
        found.append(finding("no mosaic", where, difference))
    if is_psf and (change := _border(image)) > _BORDER:
        found.append(finding("cut", where, change))
    return raw


def _phase_difference(image: np.ndarray) -> tuple[float, float, str]:
    """Difference of the means of the pixels of 2×2, its error, %, and the patterns it may be of.

    It has to be the same in most of 8×8 tiles, and two pixels of a diagonal, green, to agree.
    """
    tile = [n // (2 * _TILES) for n in image.shape]
    if min(tile) < 2:
        return 0.0, np.inf, ""
    rows, columns = (2 * _TILES * n for n in tile)
    cells = image[:rows, :columns].reshape(_TILES, tile[0], 2, _TILES, tile[1], 2)
    parts = cells.mean(axis=(1, 4)).transpose(0, 2, 1, 3).reshape(-1, 4)
    parts = parts - parts.mean(axis=1, keepdims=True)
    parts *= 100 / max(float(image.mean() - np.percentile(image, 1)), 1e-30)
    means, error = parts.mean(axis=0), parts.std(axis=0) / len(parts) ** 0.5
    greens = np.abs([means[1] - means[2], means[0] - means[3]])
    clear = np.ptp(means) > _COLOURED and (np.abs(means) > 6 * error).sum() >= 2
    clear = clear and greens.min() < 0.3 * np.ptp(means)
    patterns = ("RGGB or BGGR", "GRBG or GBRG")[int(np.argmin(greens))]
    return float(np.ptp(means)), float(error.max()), patterns if clear else ""


def _border(image: np.ndarray) -> float:
    """Change of light along the border beyond noise, % of the peak; 0 of a uniform background."""
    size, blurred = max(4, min(image.shape) // 16), scipy.ndimage.uniform_filter1d
    strips = [blurred(image[[0, -1]], size, axis=1), blurred(image[:, [0, -1]], size, axis=0)]
    first, last = np.percentile(np.concatenate([one.ravel() for one in strips]), [10, 90])
    low, high = np.percentile(image, [5, 99.9])
    return 100 * (last - first - 6 * fine_noise(image) / size**0.5) / max(high - low, 1e-30)


def _unexplained(psf: Raw, capture: Raw) -> float:
    """Part of a coarse capture's norm that a regularised inverse leaves."""
    spectra = []
    for image in (_grey(psf), _grey(capture)):
        size = max(1, min(image.shape) // _COARSE)
        image = block_mean(image[central_blocks(image.shape, size)], size)
        rows, columns = (np.hanning(n) for n in image.shape)
        spectra.append(np.fft.rfft2((image - image.mean()) * np.outer(rows, columns)))
    power = np.abs(spectra[0]) ** 2 / max(float(np.max(np.abs(spectra[0]) ** 2)), 1e-30)
    left = np.linalg.norm(1e-3 / (power + 1e-3) * spectra[1])
    return float(left / max(np.linalg.norm(spectra[1]), 1e-30))
