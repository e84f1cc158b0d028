"""Options of a preparation, and checks that PSF, capture and background are compatible."""

import numbers
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from thincam_jax._core import checks
from thincam_jax.measured.bayer import Demosaicing, Pattern
from thincam_jax.measured.raw import MeasurementError, Raw
from thincam_jax.measured.sensor import SensorCalibration

Centre = Literal["centroid", "peak", "symmetry"]
PsfChannels = Literal["each", "mean"]
PsfSum = Literal["each", "joint"]
CaptureScale = Literal["maximum", "norm", "none"]
_CHOICES = {
    **{"bayer": Pattern, "demosaicing": Demosaicing, "centre": Centre},
    **{"psf_channels": PsfChannels, "psf_sum": PsfSum, "capture_scale": CaptureScale},
}
_OPTIONAL = ("bayer", "centre")
_LARGEST = {"saturation": 1.0, "threshold": 1.0, "noise_threshold": 1e6, "psf_scale": 100.0}


@dataclass(frozen=True)
class Preparation:
    """Options of `prepare`, except the background, which is data.

    - `bayer`: the pattern of a mosaic, "RGGB", "BGGR", "GRBG" or "GBRG"; None: no mosaic.
    - `demosaicing`: "bilinear" or "superpixel" (half the size); see `demosaic`.
    - `downsample`: side of the averaged blocks, pixels of the demosaiced image.
    - `corner`: start and stop, of rows and columns alike, of the square near the PSF's upper left
      corner whose mean is the background "corner" and whose spread is its noise.
    - `saturation`: fraction of full scale from which pixels count as saturated. None: full scale,
      and no saturation in floats of unknown scale. A 12-bit converter whose bits fill the upper end
      of 16 saturates at 0.9997.
    - `threshold`: values of the PSF below this fraction of each channel's maximum become 0.
    - `noise_threshold`: values of the PSF below this many standard deviations of its noise become
      0. The noise is that of the corner's pixels divided by `downsample`, as for white noise.
    - `psf_scale`: factor that enlarges the PSF about its middle onto the capture's pixels: the
      ratio of the pixel pitches (PSF over capture) of another sensor or binning, or the scale that
      `thincam_jax.check_psf` finds. One that is larger than the capture stays whole: pixels of the
      field beside the sensor are seen through its outer parts. 1 for pixels of equal size.
    - `crop`: start and stop of the rows and of the columns of the capture to use, pixels of the
      demosaiced image, as ((100, 740), (200, 1000)). The PSF stays whole.
    - `centre`: shift the PSF by whole pixels, the same for all channels, so that its "centroid",
      its "peak" or its centre of "symmetry" (half the peak position of its convolution with itself)
      comes to the middle of the array; a single bright pixel comes to n//2. None (the default): no
      shift. A PSF shifted by s shifts the reconstruction by −s and loses light at the edge: shift
      only to compare images of several PSFs, or to crop the field around the optical axis.
    - `psf_channels`: "each" keeps the PSF of each channel, "mean" averages them.
    - `psf_sum`: "each" channel's PSF sums to 1, so that white is the colour of the PSF's light
      source; "joint" divides all by one number, so that the mean sum is 1 and the reconstruction
      keeps the sensor's colour balance.
    - `capture_scale`: divisor of the capture: its "maximum" over all channels, its Euclidean
      "norm", or "none" for fractions of full scale.

    **Errors**: MeasurementError for values out of range.
    """

    bayer: Pattern | None = None
    demosaicing: Demosaicing = "bilinear"
    downsample: int = 1
    corner: tuple[int, int] = (5, 15)
    saturation: float | int | None = None
    threshold: float | int | None = None
    noise_threshold: float | int | None = None
    psf_scale: float | int | None = None
    crop: tuple[tuple[int, int], tuple[int, int]] | None = None
    centre: Centre | None = None
    psf_channels: PsfChannels = "each"
    psf_sum: PsfSum = "each"
    capture_scale: CaptureScale = "maximum"

    def __post_init__(self):
        try:
            for name, options in _CHOICES.items():
                if getattr(self, name) is not None or name not in _OPTIONAL:
                    checks.choice(name, getattr(self, name), get_args(options))
        except ValueError as error:
            raise MeasurementError(str(error)) from None
        if not _whole(self.downsample) or self.downsample < 1:
            raise MeasurementError(
                f"downsample = {self.downsample!r}: give a whole number of at least 1"
            )
        for name, parts in {"corner": (self.corner,), "crop": self.crop or ()}.items():
            for start, stop in parts:
                if not (_whole(start) and _whole(stop) and 0 <= start < stop):
                    raise MeasurementError(
                        f"{name} = {getattr(self, name)!r}: give two whole numbers, "
                        "0 <= first < last, as (5, 15)"
                    )
        for name, high in _LARGEST.items():
            value = getattr(self, name)
            number = isinstance(value, numbers.Real) and 0 < float(value) <= high
            if value is not None and not number:
                given = checks.shown(value)
                raise MeasurementError(f"{name} = {given}: give a number above 0, up to {high:g}")


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def by_files(
    psf: Raw, capture: Raw, background: Any, options: Preparation | None, psf_background: Any
) -> tuple[Preparation, dict[str, Any]]:
    """Options, and backgrounds of "psf" and "capture", of a preparation.

    By the files where nothing is given: pattern, black levels. A background that nobody knows is
    "found". **Errors**: MeasurementError for two patterns.
    """
    options = options or Preparation()
    stated = dict.fromkeys(raw.bayer for raw in (capture, psf) if raw.bayer)
    if options.bayer is None and len(stated) > 1:
        raise MeasurementError(
            f"the capture's file ({capture.name}) says the pattern {capture.bayer} and the PSF's "
            f"({psf.name}) {psf.bayer}; give both from one sensor, stored in one orientation"
        )
    if options.bayer is None and stated and psf.channels == capture.channels == 1:
        options = replace(options, bayer=next(iter(stated)))
    levels = [raw.black_level for raw in (capture, psf)]
    if background is None or _is(background, "found"):
        background = "found" if levels[0] is None else levels[0]
        psf_background = "found" if psf_background is None else psf_background
    if psf_background is None:
        none = isinstance(background, numbers.Real) and background == 0
        psf_background = background if none or psf.bits == capture.bits else "found"
    if _is(psf_background, "found"):
        psf_background = next((level for level in levels[::-1] if level is not None), "found")
    return options, {"psf": psf_background, "capture": background}


def _is(background: Any, name: str) -> bool:
    return isinstance(background, str) and background == name


def _check_file(name: str, raw: Raw, background: Any, options: Preparation) -> None:
    """Refuse what contradicts the facts of a file, and drops them."""
    where = f"the {name}'s file ({raw.name}) says"
    if raw.bayer is not None and raw.bayer != options.bayer:
        given = "nothing is given" if options.bayer is None else f"bayer = {options.bayer!r}"
        raise MeasurementError(f"{where} the pattern {raw.bayer}, but {given}; give {raw.bayer}")
    level = raw.black_level
    number = isinstance(background, numbers.Real) and not isinstance(background, bool)
    if level and (background == "corner" or (number and abs(float(background) - level) > 1)):
        given = "a dark corner" if background == "corner" else f"background = {background}"
        raise MeasurementError(
            f"{where} a black level of {level:g}, not {given}; give {level:g}, or a dark frame"
        )


def check_match(
    psf: Raw,
    capture: Raw,
    backgrounds: dict[str, Any],
    dead: np.ndarray | None,
    options: Preparation,
) -> None:
    """Refuse incompatible data; `backgrounds` holds those of "psf" and of "capture"."""
    sizes = [psf.sensor_shape or psf.pixels.shape[:2], capture.pixels.shape[:2]]
    if sizes[0] != sizes[1] and options.psf_scale is None:
        raise MeasurementError(
            f"the PSF ({psf.name}) has {sizes[0][0]}×{sizes[0][1]} pixels and the capture "
            f"({capture.name}) {_size(capture)}; give both from the same part of one sensor, "
            "equally binned, or with `psf_scale` the ratio of their pixel pitches"
        )
    if dead is not None and dead.shape != sizes[1]:
        raise MeasurementError(
            f"the map of dead pixels has {dead.shape[0]}×{dead.shape[1]} pixels and the capture "
            f"{_size(capture)}; give a map of the same part of the sensor"
        )
    if dead is not None and dead.all():
        raise MeasurementError("the PSF has a channel of dead pixels only; check the map `dead`")
    if options.bayer is not None:
        for name, raw in (("PSF", psf), ("capture", capture)):
            if raw.channels > 1:
                raise MeasurementError(
                    f"the {name} ({raw.name}) has {raw.channels} channels, so it is no mosaic any "
                    "more; leave `bayer` out, or give the raw image"
                )
            if options.demosaicing == "superpixel" and any(n % 2 for n in raw.pixels.shape[:2]):
                raise MeasurementError(
                    f"'superpixel' joins 2×2 pixels and the {name} has {_size(raw)}: cut off the "
                    "last row or column, or leave bilinear interpolation"
                )
    if psf.channels not in (1, capture.channels) and options.psf_channels != "mean":
        raise MeasurementError(
            f"the PSF ({psf.name}) has {psf.channels} channels and the capture ({capture.name}) "
            f"{capture.channels}; give as many, or average the PSF's with `psf_channels='mean'`"
        )
    if options.corner[1] > min(psf.pixels.shape[:2]):
        raise MeasurementError(
            f"corner = {options.corner} lies outside of the PSF of {_size(psf)} pixels; "
            "give a smaller one"
        )
    for name, raw in (("psf", psf), ("capture", capture)):
        _check_background(name, raw, psf, backgrounds[name])
        _check_file({"psf": "PSF"}.get(name, name), raw, backgrounds[name], options)


def _size(raw: Raw) -> str:
    rows, columns = raw.pixels.shape[:2]
    return f"{rows}×{columns}"


def _check_background(name: str, raw: Raw, psf: Raw, background: Any) -> None:
    if isinstance(background, Raw):
        if background.pixels.shape != raw.pixels.shape:
            raise MeasurementError(
                f"the dark frame ({background.name}) has shape {background.pixels.shape} and the "
                f"{name} {raw.pixels.shape}; give one of the same camera and part of its sensor"
            )
        if background.bits != raw.bits:
            raise MeasurementError(
                f"the dark frame ({background.name}) has {_scale(background)} and the {name} "
                f"{_scale(raw)}; read both with the same `bits`"
            )
    elif isinstance(background, str):
        if background not in ("corner", "found"):
            raise MeasurementError(
                f"background = {background!r}: give a dark frame, a number of counts, 'corner' or "
                "'found'"
            )
        if background == "corner" and raw.bits != psf.bits:
            raise MeasurementError(
                f"the PSF has {_scale(psf)} and the {name} {_scale(raw)}, so the PSF's corner says "
                "nothing about it; read both with the same `bits`, or give 'found'"
            )
    elif not isinstance(background, SensorCalibration) and not np.isfinite(background):
        raise MeasurementError(f"background = {background!r}: give a finite number of counts")


def _scale(raw: Raw) -> str:
    return "an unknown full scale" if raw.bits is None else f"{raw.bits} bit"
