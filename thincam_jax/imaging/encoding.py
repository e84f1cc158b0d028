"""Encodings of light in image files: sRGB, powers, curves of ICC profiles, and orientation.

A photograph's codes are about a square root of its light; a sensor's counts are linear. EXIF's tag
of orientation (CIPA DC-008, 274) tells how the stored rows and columns lie in the picture.
"""

import contextlib
import functools
import io
import logging
import struct
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import PIL.Image
import PIL.PngImagePlugin

from thincam_jax._core import checks
from thincam_jax.units import nm

ORIENTATION = 274  # tag of EXIF and TIFF
_MOST_TAGS = 100  # of a profile
_PARAMETERS = {0: 1, 1: 3, 2: 4, 3: 5, 4: 7}  # of an ICC curve, by its kind
# Centres, widths below and above (nm) and heights of lobes whose sums are the CIE 1931 matching
# functions x, y, z to about 1 % (Wyman, Sloan and Shirley, JCGT 2(2), 2013).
_LOBES = (
    ((599.8, 37.9, 31.0, 1.056), (442.0, 16.0, 26.7, 0.362), (501.1, 20.4, 26.2, -0.065)),
    ((568.8, 46.9, 40.5, 0.821), (530.9, 16.3, 31.1, 0.286)),
    ((437.0, 11.8, 36.0, 1.217), (459.0, 26.0, 13.8, 0.681)),
)


def cie_1931(wavelength: np.ndarray) -> np.ndarray:
    """Colour matching functions x, y, z (…, 3) of light, mm, to about 1 %."""
    light = wavelength[..., None] / nm
    found = []
    for lobes in _LOBES:
        peak, low, high, height = np.array(lobes).T
        width = np.where(light < peak, low, high)
        found.append(np.sum(height * np.exp(-(((light - peak) / width) ** 2) / 2), axis=-1))
    return np.stack(found, axis=-1)


def decode_srgb(codes: np.ndarray) -> np.ndarray:
    """Light of sRGB values from 0 to 1 (IEC 61966-2-1)."""
    return np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)


def encode_srgb(light: np.ndarray) -> np.ndarray:
    """SRGB values of light from 0 to 1 (IEC 61966-2-1)."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """An image (y, x, …) turned upright from the orientation in which it is stored."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return pixels[:, ::-1] if orientation in (2, 3, 6, 7) else pixels


def decoded(codes: np.ndarray, tags: Mapping[str, Any], photograph: bool) -> np.ndarray:
    """Light of codes from 0 to 1, by the file's ICC profile, sRGB mark or gamma.

    - `tags`: tags that Pillow reads: `icc_profile`, `srgb`, `gamma`. Without them the codes of a
      `photograph` are sRGB, others are linear.
    """
    if profile := tags.get("icc_profile"):
        with contextlib.suppress(struct.error, KeyError), np.errstate(all="ignore"):
            light = _by_profile(codes, profile)
            if np.isfinite(light).all():
                return np.clip(light, 0, 1)
    if "srgb" in tags:
        return decode_srgb(codes)
    if gamma := tags.get("gamma"):
        return codes ** (1 / gamma)
    if photograph:
        say_once()
    return decode_srgb(codes) if photograph else codes


@functools.cache
def say_once() -> None:
    logging.getLogger(__name__).info(
        "photographs of 8 bit are decoded from sRGB to linear light; linear=True leaves their codes"
    )


def _by_profile(codes: np.ndarray, profile: bytes) -> np.ndarray:
    """Light of codes, by a profile's curve of red or grey (ICC.1, 10.6 and 10.18)."""
    (count,) = struct.unpack_from(">I", profile, 128)
    places = range(132, 132 + 12 * min(count, _MOST_TAGS), 12)
    tags = {profile[p : p + 4]: struct.unpack_from(">II", profile, p + 4) for p in places}
    place, size = tags[b"rTRC" if b"rTRC" in tags else b"kTRC"]
    curve = profile[place : place + size]
    if curve[:4] == b"curv":
        (count,) = struct.unpack_from(">I", curve, 8)
        numbers = struct.unpack_from(f">{count}H", curve, 12)
        if count < 2:
            return codes ** (numbers[0] / 256) if count else codes
        return np.interp(codes, np.linspace(0, 1, count), np.array(numbers) / 65535)
    kind = struct.unpack_from(">H", curve, 8)[0] if curve[:4] == b"para" else -1
    numbers = np.array(struct.unpack_from(f">{_PARAMETERS[kind]}i", curve, 12)) / 65536
    power, a, b, c, d, e, f = (*numbers, *(1, 0, 0, 0, 0, 0)[len(numbers) - 1 :])
    if kind in (1, 2):  # c is added on both sides of −b/a
        c, d, e, f = 0.0, -b / a, c, c
    bent = np.maximum(a * codes + b, 0) ** power + e
    return bent if kind == 0 else np.where(codes >= d, bent, c * codes + f)


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
    """A PNG of 8 or 16-bit grey (y, x) or 8-bit RGB (y, x, 3), which says the γ of its pixels."""
    buffer, info = io.BytesIO(), PIL.PngImagePlugin.PngInfo()
    if gamma is not None:
        info.add(b"gAMA", struct.pack(">I", min(max(round(1e5 / gamma), 1), 2**31 - 1)))
    # Of pictures with noise half the time, and a tenth smaller.
    PIL.Image.fromarray(pixels).save(buffer, format="PNG", pnginfo=info, compress_type=zlib.Z_RLE)
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
