"""PNG: 8 and 16 bit, grey and RGB, every chunk checked."""

import io
import struct
import zlib
from typing import Any

import numpy as np
import PIL.Image

from thincam_jax.measured.raw import CaptureFileError

_GREY, _RGB, _PALETTE, _GREY_ALPHA, _RGB_ALPHA = 0, 2, 3, 4, 6  # colour types of the PNG standard


def read_png(data: bytes) -> tuple[np.ndarray, int]:
    """Pixels (y, x) or (y, x, channel) and bits a sample."""
    depth, colour = _check_chunks(data)
    if colour == _PALETTE:
        raise CaptureFileError("stores a palette, no counts; save it as grey or RGB")
    if depth < 8:
        raise CaptureFileError(f"has {depth} bit a sample; 8 to 16 are read")
    if depth == 16 and colour == _GREY_ALPHA:
        raise CaptureFileError("is 16-bit grey with transparency; save it without")
    with PIL.Image.open(io.BytesIO(data)) as image:
        if getattr(image, "n_frames", 1) > 1:
            raise CaptureFileError("is animated; give one image a file")
        if depth == 8 or colour == _GREY:
            pixels = np.array(image)
        else:
            pixels = wide_colour(data, image.mode + ";16B", image.mode + ";16L")
    return without_alpha(pixels, colour in (_GREY_ALPHA, _RGB_ALPHA)), depth


def wide_colour(data: bytes, high: str, low: str) -> np.ndarray:
    """Colours of 16 bit, of which Pillow decodes one byte at a time: `high` and `low` say which."""
    halves = []
    for layout in (high, low):
        with PIL.Image.open(io.BytesIO(data)) as image:
            image.tile = [tile._replace(args=_relaid(tile.args, layout)) for tile in image.tile]
            halves.append(np.array(image).astype(np.uint16))
    return halves[0] << 8 | halves[1]


def _relaid(args: Any, layout: str) -> Any:
    return layout if isinstance(args, str) else (layout, *args[1:])


def without_alpha(pixels: np.ndarray, has_alpha: bool) -> np.ndarray:
    """The channels before the last one, if that is an alpha channel that hides nothing."""
    if not has_alpha:
        return pixels
    if (pixels[..., -1] != np.iinfo(pixels.dtype).max).any():
        raise CaptureFileError("has transparent pixels, as no capture has; save it without alpha")
    opaque = pixels[..., :-1]
    return opaque[..., 0] if opaque.shape[-1] == 1 else opaque


def _check_chunks(data: bytes) -> tuple[int, int]:
    """Bit depth and colour type, once every chunk is found whole, up to the closing one.

    Pillow alone shows what it has got of a file that is cut short near its end.
    """
    position, head = 8, None
    while True:
        if position + 12 > len(data):
            raise CaptureFileError("is cut short: the PNG's last chunks are missing")
        (length,) = struct.unpack_from(">I", data, position)
        kind = data[position + 4 : position + 8]
        end = position + 12 + length
        if end > len(data):
            raise CaptureFileError("is cut short: the PNG's last chunks are missing")
        (checksum,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(data[position + 4 : end - 4]) != checksum:
            raise CaptureFileError(f"is damaged: a chunk {kind!r} has the wrong checksum")
        if head is None:
            if kind != b"IHDR" or length != 13:
                raise CaptureFileError("is damaged: the PNG has no header")
            head = data[position + 16], data[position + 17]
        if kind == b"IEND":
            return head
        position = end
