"""Whether a PSF, a capture and what is subtracted from them belong together."""

from typing import Any

import numpy as np

from thincam_jax.measured.options import Preparation
from thincam_jax.measured.raw import MeasurementError, Raw


def check_match(
    psf: Raw,
    capture: Raw,
    backgrounds: dict[str, Any],
    dead: np.ndarray | None,
    options: Preparation,
) -> None:
    """Refuse what `prepare` cannot put together; one line.

    `backgrounds` holds those of "psf" and of "capture".
    """
    _check_sizes(psf, capture, dead)
    _check_channels(psf, capture, options)
    if options.corner[1] > min(psf.pixels.shape[:2]):
        raise MeasurementError(
            f"corner = {options.corner} lies outside of the PSF of {_size(psf)} pixels; "
            "give a smaller one"
        )
    for name, raw in (("psf", psf), ("capture", capture)):
        _check_background(name, raw, psf, backgrounds[name])


def _size(raw: Raw) -> str:
    rows, columns = raw.pixels.shape[:2]
    return f"{rows}×{columns}"


def _check_sizes(psf: Raw, capture: Raw, dead: np.ndarray | None) -> None:
    if psf.pixels.shape[:2] != capture.pixels.shape[:2]:
        raise MeasurementError(
            f"the PSF ({psf.name}) has {_size(psf)} pixels and the capture ({capture.name}) "
            f"{_size(capture)}; give both from the same part of one sensor, equally binned"
        )
    if dead is not None and dead.shape != capture.pixels.shape[:2]:
        raise MeasurementError(
            f"the map of dead pixels has {dead.shape[0]}×{dead.shape[1]} pixels and the capture "
            f"{_size(capture)}; give a map of the same part of the sensor"
        )


def _check_channels(psf: Raw, capture: Raw, options: Preparation) -> None:
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
                    "last row or column, or choose 'bilinear'"
                )
    fits = psf.channels in (1, capture.channels) or options.psf_channels == "mean"
    if not fits:
        raise MeasurementError(
            f"the PSF ({psf.name}) has {psf.channels} channels and the capture ({capture.name}) "
            f"{capture.channels}; give as many, or average the PSF's with psf_channels='mean'"
        )


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
        if background != "corner":
            raise MeasurementError(
                f"background = {background!r}: give a dark frame, a number of counts or 'corner'"
            )
        if raw.bits != psf.bits:
            raise MeasurementError(
                f"the PSF has {_scale(psf)} and the {name} {_scale(raw)}, so the PSF's corner says "
                "nothing about it; read both with the same `bits`, or give its background"
            )
        if psf.channels not in (1, raw.channels):
            raise MeasurementError(
                f"the corner of a PSF of {psf.channels} channels is no background of a {name} of "
                f"{raw.channels}; give its background"
            )
    elif not np.isfinite(background):
        raise MeasurementError(f"background = {background!r}: give a finite number of counts")


def _scale(raw: Raw) -> str:
    return "an unknown full scale" if raw.bits is None else f"{raw.bits} bit"
