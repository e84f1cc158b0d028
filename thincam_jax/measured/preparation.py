"""Preparation of a measured PSF and a capture for a reconstruction."""

import math
import warnings
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy
from jaxtyping import Bool, Float, Float32
from numpy.lib.stride_tricks import sliding_window_view

from thincam_jax._core.arguments import checked
from thincam_jax._core.grids import block_sum, central_blocks
from thincam_jax.imaging.defects import filled_by_neighbours
from thincam_jax.measured.bayer import demosaic, demosaic_mask, demosaiced
from thincam_jax.measured.merging import FoundLevels, corner_levels, find_levels
from thincam_jax.measured.options import Centre, Preparation, by_files, check_match
from thincam_jax.measured.raw import MeasurementError, Raw, with_dead
from thincam_jax.measured.sensor import SensorCalibration
from thincam_jax.measured.write import Centring, CleanUp, ImageLog, PreparationLog

# Standard deviations of noise, and counts, that more than this share of pixels are below a
# background; the share of pixels with the least detail, which tell of noise, and the quantile of
# the absolute values of a normal distribution there.
_BELOW, _COUNTS, _DARKER, _STILL, _OF_NORMAL = 6.0, 2.0, 0.02, 0.1, 0.1257

Background = Raw | SensorCalibration | float | int | Literal["corner", "found"]


@dataclass(frozen=True, eq=False)
class Prepared:
    """A PSF and a capture, linear, on pixels of the same size.

    - `psf`: one channel, or one for each of the capture's; sums to 1 (`psf_sum`). It is whole, and
      so may have more pixels than the capture.
    - `capture`: in fractions of full scale divided by `log.capture_divisor`.
    - `valid`: False where the capture is saturated or dead.
    - `log`: numbers of the steps.
    - `noise_variance`: the capture's, by a sensor's calibration, for independent values before
      `downsample`; infinite where not valid.
    """

    psf: Float32[np.ndarray, "psf_channel k l"]
    capture: Float32[np.ndarray, "channel y x"]
    valid: Bool[np.ndarray, "channel y x"]
    log: PreparationLog
    noise_variance: Float32[np.ndarray, "channel y x"] | None = None


@dataclass(frozen=True, eq=False)
class _Frame:
    """An image between two steps, in fractions of full scale."""

    values: np.ndarray  # (channel, y, x) float32
    saturated: np.ndarray  # bool
    known: np.ndarray  # bool; False where only dead pixels contribute
    variance: np.ndarray  # 0 without a sensor's calibration

    @property
    def shape(self) -> tuple[int, int]:
        rows, columns = self.values.shape[-2:]
        return rows, columns


@checked
def prepare(
    psf: Raw,
    capture: Raw,
    *,
    background: Background | None = None,
    options: Preparation | None = None,
    psf_background: Background | None = None,
    dead: Bool[np.ndarray, "y x"] | None = None,
) -> Prepared:
    """Convert a measured PSF and a capture to linear units, cleaned and resampled.

    The steps, of which the result's `log` tells:

    1. Counts to fractions of full scale, float32.
    2. Background: subtract a dark frame (of the image's exposure), or a number of counts; 0
       subtracts nothing. None or "found": the black level of the image's file, else that of a
       corner of the PSF that proves dark (see `find_levels`), else the lowest value for the PSF
       and nothing for the capture, whose uniform background is then found with the image.
       "corner": the mean of a square in the PSF's upper left corner, untested, for both. A
       `SensorCalibration` `at` the image's exposure also divides by the response of each pixel and
       gives the variance. `psf_background` is that of the PSF where it differs; a PSF of another
       bit depth has its own, given or found. Negative values become 0.
    3. Saturated pixels (before the subtraction), `dead` ones, True in a map (y, x) of the sensor
       (`read_pixel_map`), and defective ones by the calibration are not valid.
    4. Demosaicing, if the options name a Bayer pattern; then the capture's `crop`.
    5. The PSF onto the capture's pixels, with `psf_scale`.
    6. Exact means of square blocks of `downsample` pixels; remainders are cropped centrally.
    7. Small values of the PSF to zero, optional.
    8. The PSF to the middle of its array, optional.
    9. One PSF for all channels, optional.
    10. The PSF to unit sum, the capture by `capture_scale`.

    In 4 and 6 dead pixels are left out of the means, as they are missing at random; a value without
    any good pixel is invalid and filled by its neighbours. A saturated pixel invalidates
    every value that it enters, because a mean of the others would be too dark. Saturated pixels of
    the PSF are only counted in the log; they call for a PSF of shorter exposure.

    **Errors**: MeasurementError, one line: incompatible sizes, channels or bit depths, a black PSF
    or capture. **Warns** where no corner of the PSF is dark.

    Pattern, black levels and dead pixels that nobody gives are those of the files.
    """
    options, backgrounds = by_files(psf, capture, background, options, psf_background)
    check_match(psf, capture, backgrounds, dead, options)
    raws = {"psf": with_dead(psf, dead), "capture": with_dead(capture, dead)}
    planes = {name: _in_full_scale(raw) for name, raw in raws.items()}
    found = _found(planes, backgrounds, raws, options)
    levels = {n: _level(b, raws[n], found.levels[n]) for n, b in backgrounds.items()}
    frames = {
        n: _frame(raws[n], plane, backgrounds[n], levels[n], options) for n, plane in planes.items()
    }
    given = [n for n, one in backgrounds.items() if not isinstance(one, str)]
    darker = {n: _darker(raws[n], frames[n]) for n in given}
    noise = _noise(frames["psf"].values[found.square].astype(np.float64), options)
    kinds = {n: _kind(b, raws[n], found.sources[n]) for n, b in backgrounds.items()}
    logs = {n: _image_log(raws[n], kinds[n], levels[n], f) for n, f in frames.items()}
    frames = {n: replace(f, values=np.maximum(f.values, 0)) for n, f in frames.items()}
    if options.bayer is not None:
        frames = {n: _demosaiced(f, options) for n, f in frames.items()}
    if options.crop is not None:
        frames["capture"] = _cropped(frames["capture"], options.crop)
    shape = frames["capture"].shape
    if options.psf_scale is not None:
        frames["psf"] = _resampled(frames["psf"], shape, float(options.psf_scale))
    psf_shape = frames["psf"].shape
    frames, kept = _downsampled(frames, options.downsample)
    light, cleaned = clean(
        _filled(frames["psf"], "PSF"), noise, options.threshold, options.noise_threshold
    )
    centring = None
    if options.centre is not None:
        light, centring = centre_psf(light, options.centre)
    if options.psf_channels == "mean":
        light = light.mean(axis=0, keepdims=True, dtype=np.float64).astype(np.float32)
    image = _filled(frames["capture"], "capture")
    sums, divisor = _psf_divisor(light, options), _capture_divisor(image, options)
    _warn_of_darker(raws, darker)
    valid = frames["capture"].known & ~frames["capture"].saturated
    variance = np.where(valid, frames["capture"].variance / np.float32(divisor**2), np.inf)
    variance = variance if isinstance(backgrounds["capture"], SensorCalibration) else None
    log = PreparationLog(
        options=options,
        psf=logs["psf"],
        capture=logs["capture"],
        valid_share=float(valid.mean()),
        psf_shape=psf_shape,
        first_pixel=tuple(part.start for part in kept),
        cropped_to=tuple(part.stop - part.start for part in kept),
        shape=frames["capture"].shape,
        noise=tuple(noise.tolist()),
        clean_up=cleaned,
        centring=centring,
        psf_divisor=tuple(sums.tolist()),
        capture_divisor=divisor,
    )
    light = (light / sums[:, None, None]).astype(np.float32)
    image = (image.astype(np.float64) / divisor).astype(np.float32)
    return Prepared(light, image, valid, log, variance)


def _found(planes, backgrounds: dict[str, Background], raws, options: Preparation) -> FoundLevels:
    """Background levels of the images that come without one; warns where no corner is dark."""
    sought = [name for name, one in backgrounds.items() if isinstance(one, str) and one == "found"]
    if not sought:
        side = slice(*options.corner)
        return corner_levels(planes, (slice(None), side, side))
    comparable = raws["psf"].bits == raws["capture"].bits
    seen = planes if comparable else {"psf": planes["psf"]}
    found = find_levels(seen, options.corner, options.bayer)
    if "capture" in sought and not comparable:
        text = "its background is found with the image, whose black may turn grey; a dark frame or"
        warnings.warn(f"{raws['capture'].name}: {text} a number of counts is better", stacklevel=4)
    if "psf" in sought and found.sources["psf"] != "corner":
        warnings.warn(
            f"no corner of the PSF ({raws['psf'].name}) is dark: its lowest value is taken as its "
            "black level; a background is better, a dark frame or a number of counts",
            stacklevel=4,
        )
    return found


def _kind(background: Background, raw: Raw, found: str) -> str:
    """The source of a level, in words."""
    if isinstance(background, SensorCalibration):
        return f"sensor's calibration at {background.exposure:g} s"
    if isinstance(background, Raw):
        return f"dark frame {background.name}"
    if isinstance(background, str):
        return found
    return "black level of the file" if background == raw.black_level else "number"


def _image_log(raw: Raw, background: str, level: np.ndarray, frame: _Frame) -> ImageLog:
    maximum = raw.pixels.max()
    return ImageLog(
        name=raw.name,
        format=raw.format,
        shape=raw.pixels.shape,
        bits=raw.bits,
        full_scale=raw.full_scale,
        minimum=float(raw.pixels.min()),
        maximum=float(maximum),
        pixels_at_maximum=int(np.count_nonzero(raw.pixels == maximum)),
        background=background,
        level=tuple(level.mean(axis=(1, 2), dtype=np.float64).tolist()),
        clipped=int(np.count_nonzero(frame.values < 0)),
        saturated=int(frame.saturated.sum()),
        dead=int((~frame.known).sum()) // raw.channels,
        noise=raw.full_scale * float(np.sqrt(frame.variance.mean(dtype=float))) or None,
    )


def _frame(
    raw: Raw, plane: np.ndarray, background: Background, level: np.ndarray, options: Preparation
) -> _Frame:
    """An image, `plane` in full scale, without its background."""
    saturated, good = _saturated(raw, plane, options), np.ones(plane.shape, bool)
    if raw.dead is not None:
        good = np.broadcast_to(~raw.dead, plane.shape)
    if not isinstance(background, SensorCalibration):
        return _Frame(plane - level, saturated, good, np.zeros_like(plane))
    light, variance = (one[None].astype(np.float32) for one in background.correct(raw))
    scale = np.float32(raw.full_scale)
    return _Frame(light / scale, saturated, good & ~background.defective, variance / scale**2)


def _darker(raw: Raw, frame: _Frame) -> float:
    """Share of pixels that are darker than the background that was subtracted by more than noise.

    The noise is that of the pixels with the least detail: where a code is fine, there are few.
    """
    if min(frame.shape) < 8:
        return 0.0
    bends = np.abs(np.diff(np.diff(frame.values, 2, axis=1), 2, axis=2))  # of 6 times the noise
    usable = frame.known & ~frame.saturated  # a plateau has no noise
    for axis in (1, 2):
        usable = np.min(sliding_window_view(usable, 3, axis=axis), axis=-1)
    parts = (bend[use] for bend, use in zip(bends, usable, strict=True))
    still = [np.quantile(part, _STILL) if part.size else np.inf for part in parts]
    noise = np.reshape(still, (-1, 1, 1)) / (6 * _OF_NORMAL)
    below = frame.values < -_BELOW * noise - _COUNTS / raw.full_scale
    return float((below & frame.known).mean())


def _warn_of_darker(raws: dict[str, Raw], shares: dict[str, float]) -> None:
    for name, share in shares.items():
        if share > _DARKER:
            warnings.warn(
                f"{raws[name].name}: {100 * share:.0f} % of its pixels are darker than the "
                "background that was given, and become black; leave it out, or give one of this "
                "exposure",
                stacklevel=4,
            )


def _in_full_scale(raw: Raw) -> np.ndarray:
    """(channel, y, x) float32."""
    pixels = raw.pixels[..., None] if raw.pixels.ndim == 2 else raw.pixels
    planes = np.moveaxis(pixels, -1, 0).astype(np.float32)
    return planes / np.float32(raw.full_scale)


def _saturated(raw: Raw, planes: np.ndarray, options: Preparation) -> np.ndarray:
    if raw.saturation is not None and options.saturation is None:
        return planes >= np.float32(raw.saturation) / np.float32(raw.full_scale)
    if raw.bits is None and options.saturation is None:
        return np.zeros(planes.shape, bool)
    return planes >= np.float32(options.saturation or 1.0)


def _noise(part: np.ndarray, options: Preparation) -> np.ndarray:
    """Standard deviation of a pixel after block means, for each channel, from a dark part."""
    if options.bayer is None:
        spread = part.std(axis=(1, 2))
    else:  # within each colour, as their means may differ
        variances = [part[0, i::2, j::2].var() for i in range(2) for j in range(2)]
        spread = np.sqrt(np.mean(variances, keepdims=True))
    return spread / options.downsample


def _level(background: Background, raw: Raw, found: np.ndarray) -> np.ndarray:
    """Level to subtract, in fractions of full scale."""
    if isinstance(background, Raw):
        return _in_full_scale(background)
    if isinstance(background, SensorCalibration):
        return background.dark_level[None] / np.float32(raw.full_scale)
    if isinstance(background, str):
        return found
    return np.full((1, 1, 1), background / raw.full_scale, np.float32)


def _demosaiced(frame: _Frame, options: Preparation) -> _Frame:
    pattern, method = options.bayer, options.demosaicing
    assert pattern is not None
    known = None if frame.known.all() else frame.known[0]
    colours = demosaic(frame.values[0], pattern, method, known)
    nothing = np.zeros(colours.shape, bool)
    saturated, variance = nothing, np.zeros_like(colours)
    if frame.saturated.any():
        saturated = demosaic_mask(frame.saturated[0], pattern, method)
    if frame.variance.any():
        variance = demosaiced(frame.variance[0], pattern, method, known, 2)
    has = ~nothing if known is None else demosaic_mask(known, pattern, method)
    planes = colours, saturated, has, variance
    return _Frame(*(np.moveaxis(plane, -1, 0) for plane in planes))


def _cropped(frame: _Frame, crop: tuple[tuple[int, int], tuple[int, int]]) -> _Frame:
    shape = frame.values.shape[1:]
    if any(stop > n for (_, stop), n in zip(crop, shape, strict=True)):
        raise MeasurementError(
            f"crop = {crop} lies outside of the capture of {shape[0]}×{shape[1]} pixels; give a "
            "smaller one"
        )
    parts = [slice(*part) for part in crop]
    return _Frame(*(plane[:, *parts] for plane in vars(frame).values()))


def _resampled(frame: _Frame, shape: tuple[int, ...], scale: float) -> _Frame:
    """A PSF enlarged about its middle by cubic splines, zero-padded to at least a shape.

    Before a reduction it is blurred, with half the additional pixel width as σ.
    """
    planes = _filled(frame, "PSF").astype(np.float64)
    sizes = zip(shape, planes.shape[-2:], strict=True)
    shape = tuple(max(n, math.floor(k * scale)) for n, k in sizes)
    blur = max(0.0, (1 / scale - 1) / 2)
    middle, other = ((np.array(n[-2:]) - 1) / 2 for n in (planes.shape, shape))
    values = [
        scipy.ndimage.affine_transform(
            scipy.ndimage.gaussian_filter(plane, blur, mode="nearest") if blur else plane,
            np.full(2, 1 / scale),
            middle - other / scale,
            output_shape=shape,
        )
        for plane in planes
    ]
    light = np.maximum(np.stack(values), 0).astype(frame.values.dtype)
    nothing = np.zeros(light.shape, bool)
    return _Frame(light, nothing, ~nothing, np.zeros_like(light))


def _downsampled(
    frames: dict[str, _Frame], factor: int
) -> tuple[dict[str, _Frame], tuple[slice, slice]]:
    """Block means, which one pixel of that size would have measured, and what they cover."""
    shape = frames["capture"].shape
    if factor > min(shape):
        raise MeasurementError(
            f"downsample = {factor} is larger than the image of {shape[0]}×{shape[1]} pixels"
        )
    if factor > 1:
        frames = {name: _means(frame, factor) for name, frame in frames.items()}
    return frames, central_blocks(shape, factor)


def _means(frame: _Frame, factor: int) -> _Frame:
    """Means of the known pixels of each block, summed in float64; 0 where none is known."""
    kept = central_blocks(frame.values.shape[1:], factor)
    values, saturated, known, variance = (plane[:, *kept] for plane in vars(frame).values())
    total = block_sum(np.where(known, values, 0), factor, np.float64)
    spread = np.zeros_like(total)
    if variance.any():
        spread = block_sum(np.where(known, variance, 0), factor, np.float64)
    count = block_sum(known, factor)
    means, spread = total / np.maximum(count, 1), spread / np.maximum(count, 1) ** 2
    saturated = block_sum(saturated, factor) > 0
    return _Frame(means.astype(values.dtype), saturated, count > 0, spread.astype(values.dtype))


def _filled(frame: _Frame, name: str) -> np.ndarray:
    """The image with each unknown value between those around it."""
    if frame.known.all():
        return frame.values
    if not frame.known.any(axis=(1, 2)).all():
        raise MeasurementError(
            f"the {name} has a channel of dead pixels only; check the map `dead`"
        )
    pairs = zip(frame.values, frame.known, strict=True)
    return np.stack([filled_by_neighbours(values, ~known) for values, known in pairs])


def _psf_divisor(psf: np.ndarray, options: Preparation) -> np.ndarray:
    sums = psf.sum(axis=(1, 2), dtype=np.float64)
    if not (sums > 0).all():
        raise MeasurementError(
            f"the PSF is black in channel {int(np.argmin(sums))} once the background is subtracted "
            "and small values removed; give a lower background, threshold or noise_threshold"
        )
    return np.full_like(sums, sums.mean()) if options.psf_sum == "joint" else sums


def _capture_divisor(capture: np.ndarray, options: Preparation) -> float:
    precise = capture.astype(np.float64)
    if not precise.max() > 0:
        raise MeasurementError(
            "the capture is black once the background is subtracted; give a lower background"
        )
    if options.capture_scale == "none":
        return 1.0
    return float(precise.max() if options.capture_scale == "maximum" else np.linalg.norm(precise))


def clean(
    psf: Float[np.ndarray, "channel y x"],
    noise: Float[np.ndarray, "#channel"],
    threshold: float | int | None = None,
    noise_threshold: float | int | None = None,
) -> tuple[Float[np.ndarray, "channel y x"], CleanUp]:
    """The PSF with its small values set to zero, and a record of what that removed.

    Small is below the larger of `threshold` times each channel's maximum and `noise_threshold`
    times its `noise`. Remaining noise acts as haze on the reconstruction; but faint parts of the
    PSF are lost, too.
    """
    levels = np.zeros(psf.shape[0])
    if threshold is not None:
        levels = np.maximum(levels, threshold * psf.max(axis=(1, 2)))
    if noise_threshold is not None:
        levels = np.maximum(levels, noise_threshold * noise)
    small = psf < levels[:, None, None]
    kept = np.where(small, psf.dtype.type(0), psf)
    light = float(psf.sum(dtype=np.float64))
    removed = 1 - float(kept.sum(dtype=np.float64)) / light if light > 0 else 0.0
    zeroed = int(np.count_nonzero(small & (psf > 0)))
    return kept, CleanUp(tuple(levels.tolist()), zeroed, removed)


def centre_psf(
    psf: Float[np.ndarray, "channel y x"], by: Centre
) -> tuple[Float[np.ndarray, "channel y x"], Centring]:
    """The PSF shifted by whole pixels to the middle of its array, and a record of the shift.

    `by`: "centroid", "peak" or "symmetry" (see `Preparation`) of the channels' sum. Pixels shifted
    out of the array are lost, those shifted in are 0.
    """
    found = _centre(psf.sum(axis=0, dtype=np.float64), by)
    sides = zip(psf.shape[1:], found, strict=True)
    # Rounded up at a half, so that a single bright pixel comes to n//2, the origin of a DFT.
    rows, columns = (math.floor((n - 1) / 2 - c + 0.5) for n, c in sides)
    moved = scipy.ndimage.shift(psf, (0, rows, columns), order=0)
    light = float(psf.sum(dtype=np.float64))
    lost = 1 - float(moved.sum(dtype=np.float64)) / light if light > 0 else 0.0
    return moved, Centring(found, (rows, columns), lost)


def _centre(image: np.ndarray, by: Centre) -> tuple[float, float]:
    """Row and column, in (half) pixels from the first."""
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
