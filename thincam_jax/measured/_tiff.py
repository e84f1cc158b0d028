"""TIFF: 8 to 16 bit and floats, grey and RGB, one image a file."""

import contextlib
import io
import logging
import sys
from collections.abc import Iterator

import numpy as np
import PIL.Image
import tifffile

from thincam_jax.measured._png import wide_colour, without_alpha
from thincam_jax.measured.raw import CaptureFileError

# Read as they are: no palette, no inverted scale, no colour difference.
_PLAIN = (
    tifffile.PHOTOMETRIC.MINISBLACK,
    tifffile.PHOTOMETRIC.RGB,
    tifffile.PHOTOMETRIC.CFA,
    tifffile.PHOTOMETRIC.LINEAR_RAW,
)


def read_tiff(data: bytes) -> tuple[np.ndarray, int | None]:
    """Pixels (y, x) or (y, x, channel) and bits a sample; no bits for floats."""
    with _silence(), tifffile.TiffFile(io.BytesIO(data)) as file:
        page = _only_page(file)
        if page.photometric not in _PLAIN:
            name = getattr(page.photometric, "name", page.photometric)
            raise CaptureFileError(f"stores colours as {name}, no counts; save it as grey or RGB")
        if page.axes not in ("YX", "YXS", "SYX"):
            raise CaptureFileError(
                f"has axes {page.axes}; give one image (y, x) or (y, x, channel)"
            )
        if page.size == 0:
            raise CaptureFileError("is empty: its image has no pixels")
        _check_whole(page, len(data))
        if page.compression == tifffile.COMPRESSION.LZW:
            pixels = _read_lzw(data, page)
        else:
            pixels = page.asarray()
        bits = page.bitspersample
        if page.axes == "SYX":
            pixels = np.moveaxis(pixels, 0, -1)
        alpha = bool(page.extrasamples) and page.extrasamples[-1] in (1, 2)
    pixels = without_alpha(pixels, alpha and pixels.ndim == 3 and pixels.dtype.kind == "u")
    is_count = pixels.dtype.kind == "u" and isinstance(bits, int)
    return pixels, bits if is_count and 8 <= bits <= 16 else None


def _only_page(file: tifffile.TiffFile) -> tifffile.TiffPage:
    """The file's one image; previews of lower resolution do not count."""
    pages = [page.aspage() for page in file.pages]
    whole = [page for page in pages if not page.is_reduced] or pages[:1]
    if not whole:
        raise CaptureFileError("is cut short: the TIFF holds no image")
    if len(whole) > 1:
        shapes = {page.shape for page in whole}
        what = " of different sizes" if len(shapes) > 1 else ""
        raise CaptureFileError(f"holds {len(whole)} images{what}; give one image a file")
    return whole[0]


def _check_whole(page: tifffile.TiffPage, size: int) -> None:
    """Refuse strips that lie behind the file's end, or are missing: they would read as zeros."""
    strips = list(zip(page.dataoffsets, page.databytecounts, strict=True))
    if not strips or any(count == 0 or offset + count > size for offset, count in strips):
        raise CaptureFileError("is cut short: a part of the TIFF's pixels is missing")
    plain = page.compression == tifffile.COMPRESSION.NONE
    if plain and isinstance(page.bitspersample, int):
        needed = (page.size * page.bitspersample) // 8
        if sum(count for _, count in strips) < needed:
            raise CaptureFileError("is damaged: the TIFF has fewer pixels than it announces")


def _read_lzw(data: bytes, page: tifffile.TiffPage) -> np.ndarray:
    """LZW, as OpenCV writes it, by way of Pillow: tifffile would need another package."""
    with PIL.Image.open(io.BytesIO(data)) as image:
        mode = image.mode
        pixels = None if page.bitspersample == 16 and page.ndim == 3 else np.array(image)
    if pixels is None:
        ends = ("L", "B") if sys.byteorder == "little" else ("B", "L")
        pixels = wide_colour(data, *(f"{mode};16{end}" for end in ends))
    if pixels.shape != page.shape or pixels.dtype.itemsize * 8 != page.bitspersample:
        raise CaptureFileError(
            "is compressed (LZW) in a way that is not read; save it uncompressed"
        )
    return pixels


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Without tifffile's remarks on standard error: what is wrong is told by the error."""
    logger = logging.getLogger("tifffile")
    before = logger.disabled
    logger.disabled = True
    try:
        yield
    finally:
        logger.disabled = before
