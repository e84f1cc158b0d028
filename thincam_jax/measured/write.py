"""Writing an image and the record of how it was made, each whole or not at all."""

import io
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import tifffile
from jaxtyping import ArrayLike, Float

from thincam_jax._core.files import write_whole
from thincam_jax.measured.display import WhiteBalance, to_display
from thincam_jax.measured.raw import MeasurementError

LINEAR = (".npy", ".tif", ".tiff")


def write_image(
    path: str | os.PathLike[str],
    image: Float[ArrayLike, "channel y x"],
    log: Mapping[str, Any] | None = None,
    *,
    white_balance: WhiteBalance = None,
    gamma: float | int = 2.2,
    percentile: float | int = 99.9,
) -> Path:
    """Write a linear image (channel, y, x), and `log` beside it as NAME.json.

    The suffix says how: `.png` 8 bit for looking at, by `to_display` with the keyword arguments;
    `.npy`, `.tif` and `.tiff` float32, linear, (y, x) or (y, x, channel). The folder must exist.
    The log is written first, so that an image never stands there without it.

    **Errors**: MeasurementError for another suffix and an image that cannot be displayed; OSError
    where nothing can be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".png", *LINEAR):
        raise MeasurementError(
            f"{path}: images are written as .png (for looking at), .npy or .tif (linear); "
            "give one of these suffixes"
        )
    if suffix == ".png":
        content = png_bytes(
            to_display(image, white_balance=white_balance, gamma=gamma, percentile=percentile)
        )
    else:
        content = _linear_bytes(np.asarray(image, dtype=np.float32), suffix)
    if log is not None:
        write_whole(path.with_suffix(".json"), log_text(log))
    return write_whole(path, content)


def png_bytes(pixels: np.ndarray) -> bytes:
    """A PNG file of 8-bit grey (y, x) or RGB (y, x, 3)."""
    buffer = io.BytesIO()
    PIL.Image.fromarray(pixels).save(buffer, format="PNG")
    return buffer.getvalue()


def log_text(log: Mapping[str, Any]) -> str:
    """JSON with sorted keys; numbers that are not finite become null, arrays lists."""
    plain = _plain(log)
    return json.dumps(plain, indent=2, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"


def _linear_bytes(image: np.ndarray, suffix: str) -> bytes:
    stored = image[0] if image.shape[0] == 1 else np.moveaxis(image, 0, -1)
    stored = np.ascontiguousarray(stored)
    buffer = io.BytesIO()
    if suffix == ".npy":
        np.save(buffer, stored, allow_pickle=False)
    else:
        colours = stored.ndim == 3 and stored.shape[2] == 3
        tifffile.imwrite(
            buffer,
            stored,
            photometric="rgb" if colours else "minisblack",
            planarconfig="contig" if stored.ndim == 3 else None,
            metadata=None,
        )
    return buffer.getvalue()


def _plain(value: Any) -> Any:
    """What JSON can hold."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    array = np.asarray(value)  # numbers and arrays of NumPy and JAX
    if array.dtype.kind not in "buif":
        raise TypeError(f"a log holds numbers, texts, lists and dicts, not {type(value).__name__}")
    return _plain(array.tolist())
