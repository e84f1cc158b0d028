"""Linear images as 8-bit pictures."""

import io
import struct
from typing import Any

import numpy as np
import PIL.Image
import PIL.PngImagePlugin

from thincam_jax._core import checks
from thincam_jax.imaging.encoding import encode_srgb

_QUALITY = 85  # of JPEG


def eight_bit(
    linear: np.ndarray, gamma: float | int | None = None, percentile: float | int = 99.9
) -> np.ndarray:
    """round(255 clip(I/w, 0, 1)^(1/γ)), w this percentile of I; the maximum where that is 0.

    Without γ the encoding is that of sRGB.
    """
    balanced = np.maximum(linear, 0.0)
    white = np.percentile(balanced, percentile) or balanced.max()
    shown = np.clip(balanced / white, 0.0, 1.0) if white > 0 else balanced
    encoded = encode_srgb(shown) if gamma is None else shown ** (1 / gamma)
    return np.round(255 * encoded).astype(np.uint8)


def png_bytes(pixels: np.ndarray, gamma: float | int | None = None) -> bytes:
    """A PNG file of 8-bit grey (y, x) or RGB (y, x, 3), which says the γ of its pixels."""
    buffer, info = io.BytesIO(), PIL.PngImagePlugin.PngInfo()
    if gamma is not None:
        info.add(b"gAMA", struct.pack(">I", min(max(round(1e5 / gamma), 1), 2**31 - 1)))
    PIL.Image.fromarray(pixels).save(buffer, format="PNG", pnginfo=info)
    return buffer.getvalue()


def jpeg_bytes(pixels: np.ndarray) -> bytes:
    """A JPEG file of the same: smaller, and a few levels off."""
    buffer = io.BytesIO()
    PIL.Image.fromarray(pixels).save(buffer, format="JPEG", quality=_QUALITY)
    return buffer.getvalue()


def as_picture(image: np.ndarray) -> np.ndarray:
    """Picture (y, x) or (y, x, channel) of an image (channel, y, x)."""
    picture = np.moveaxis(image, 0, -1)
    return picture[..., 0] if picture.shape[-1] == 1 else picture


def pictures(image: Any, *, planes: bool = False) -> list[np.ndarray]:
    """The images of (*batch, y, x), each (y, x) or, of three channels, (y, x, 3), colours last.

    A photograph, (y, x, 3), is taken as it is.

    With `planes` the last batch axis counts planes, and is not the colour channel.
    """
    image = np.nan_to_num(checks.numbers("image", image).astype(float))
    if image.ndim < 2 or image.size == 0:
        raise ValueError(f"image has shape {image.shape}; give (y, x) or (3, y, x), not empty")
    if not planes and image.ndim == 3 and checks.colours_last(image.shape):
        return [image[..., :3]]
    if not planes and image.ndim > 2 and image.shape[-3] == 3:
        return list(np.moveaxis(image.reshape(-1, *image.shape[-3:]), 1, -1))
    return list(image.reshape(-1, *image.shape[-2:]))
