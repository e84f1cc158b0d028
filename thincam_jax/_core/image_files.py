"""Image files before they are decoded: no larger than they say, and with all of their parts.

Decoders fill what is missing with zeros or noise, and unpack all that a file announces.
"""

import contextlib
import io
import itertools
import math
import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import tifffile

from thincam_jax._core.files import open_regular
from thincam_jax._core.memory import refuse_if_too_large

_STARTS = {
    b"\x89PNG\r\n\x1a\n": "png",
    b"\x93NUMPY": "npy",
    b"\xff\xd8\xff": "jpeg",
    **{b"P5": "pgm", b"P6": "pgm", b"PK\3\4": "npz", b"\x89HDF\r\n\x1a\n": "hdf5"},
    **{b"MATLAB 5": "mat", b"MATLAB 7": "mat73", b"SIMPLE  ": "fits"},
    **dict.fromkeys((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), "tiff"),  # +: of more than 4 GB
}
# Raw files of cameras, most of which are TIFF with previews of their own.
RAW_SUFFIXES = (".dng", ".arw", ".cr2", ".cr3", ".nef", ".orf", ".pef", ".raf", ".rw2")
# Largest ratio of pixel bytes to file bytes: LZW, the densest usual compression, reaches some 2500
# for a black image. Anything beyond is a decompression bomb.
_DENSEST = 4000
_MOST_PIXELS = 2**27  # of one packed image
_MOST_PAGES, _MOST_SCANS = 4000, 100  # of a TIFF, and a JPEG
_BESIDE = 2**26  # bytes of a file that may be no pixels
_LARGEST = 2**29  # bytes of a file whose pixels are not known before it is decoded
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour type
# First column and row of the passes of an interlaced PNG, and their steps.
_PASSES = (
    *((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4)),
    *((0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2)),
)
_JPEG_SCAN, _JPEG_END = b"\xff\xda", b"\xff\xd9"


class ImageFileError(ValueError):
    """An image file that is not to be decoded; one line without its name."""


def kind_of(path: str | os.PathLike[str]) -> str | None:
    """Kind of an image by its first bytes, "raw" by its name too.

    "" of a file that ends within these bytes, None of others.
    """
    with open_regular(path) as (file, _):
        return kind_of_start(file.read(8), Path(path).suffix)


def kind_of_start(start: bytes, suffix: str = "") -> str | None:
    """`kind_of` by the first 8 bytes, and the suffix of the name."""
    if any(one.startswith(start) and one != start for one in _STARTS):
        return ""
    if suffix.lower() in RAW_SUFFIXES:
        return "raw"
    return next((kind for one, kind in _STARTS.items() if start.startswith(one)), None)


def read_whole(path: str | os.PathLike[str], kind: str | None) -> bytes:
    """All bytes of an image file of a kind.

    **Errors**: ImageFileError, before it is read, for a file that is larger than its image can be,
    or an image larger than its file; ValueError and others for one with parts missing.
    """
    with open_regular(path) as (file, size):
        return whole_of(file, size, kind)


def whole_of(file: Any, size: int, kind: str | None) -> bytes:
    """`read_whole` of an open file of `size` bytes, or of what was read before."""
    most = _LARGEST
    if kind in _SIZES:
        pixels, held = _SIZES[kind](file)
        if held > _DENSEST * size:
            raise ImageFileError(
                f"announces {held} bytes of pixels, more than its {size} can hold: it is damaged"
            )
        if pixels > _MOST_PIXELS and size < held:
            raise ImageFileError(
                f"announces {pixels} packed pixels, at most {_MOST_PIXELS} are read; save it "
                "without compression, or a smaller one"
            )
        refuse_if_too_large("its image", held, "give a smaller one")
        most = 4 * held + _BESIDE
    if size > most:
        raise ImageFileError(f"holds {size} bytes, more than its image needs: it is damaged")
    file.seek(0)
    data = file.read(size)
    _CHECKS.get(kind, len)(data)
    return data


def rawpy() -> Any:
    """The library that reads cameras' raw files. **Errors**: ImageFileError where it is not."""
    try:
        import rawpy
    except ImportError:
        raise ImageFileError(
            "is a camera's raw file; pip install 'thincam_jax[raw]', or save it as TIFF"
        ) from None
    return rawpy


def npy_header(file: Any) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type of an NPY file, whose values come next. **Errors**: ImageFileError."""
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ImageFileError(f"is NPY of version {version}; save it with numpy.save")
    shape, _, dtype = getattr(np.lib.format, f"read_array_header_{version[0]}_0")(file)
    return shape, dtype


def _npy_size(file: Any) -> tuple[int, int]:
    """Number of values and bytes by the header, before NumPy allocates them."""
    shape, dtype = npy_header(file)
    begin, count = file.tell(), math.prod(int(n) for n in shape)
    size, held = dtype.itemsize * count, file.seek(0, os.SEEK_END) - begin
    if not dtype.hasobject and size > held:
        raise ImageFileError(f"is cut short: {held} of the {size} bytes of its values are there")
    return count, size


def png_header(data: bytes) -> tuple[int, ...]:
    """Columns, rows, bits a sample, colour type, two zeros, and whether it is interlaced."""
    return struct.unpack_from(">IIBBBBB", data, 16)


def _png_size(file: Any) -> tuple[int, int]:
    columns, rows, depth, colour, *_ = png_header(file.read(29))
    return rows * columns, rows * columns * _PNG_CHANNELS[colour] * depth // 8


def _check_png(data: bytes) -> None:
    """Checksums of all chunks, and as many bytes of pixels as the header announces."""
    columns, rows, depth, colour, *_, interlaced = png_header(data)
    passes = _PASSES if interlaced else ((0, 0, 1, 1),)
    parts = [(-(-(columns - x) // dx), -(-(rows - y) // dy)) for x, y, dx, dy in passes]
    bits = _PNG_CHANNELS[colour] * depth
    missing = sum(h * (1 + -(-w * bits // 8)) for w, h in parts if w > 0)
    place, kind, unpacked = 8, b"", zlib.decompressobj()
    while kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", data, place)
        place += 12 + length
        body = memoryview(data)[place - 8 - length : place - 4]
        if zlib.crc32(body) != struct.unpack_from(">I", data, place - 4)[0]:
            raise ValueError("a checksum is wrong")
        if kind == b"IDAT" and missing >= 0:
            missing -= len(unpacked.decompress(body[4:], missing + 1))
    if missing or not unpacked.eof:
        raise ValueError("its data are not those of all rows")


def _jpeg_size(file: Any) -> tuple[int, int]:
    image = PIL.Image.open(file)
    return math.prod(image.size), math.prod(image.size) * len(image.getbands())


def _check_jpeg(data: bytes) -> None:
    """Limit the scans, each of which is decoded; `opened` finds those cut short."""
    if (count := data.count(_JPEG_SCAN)) > _MOST_SCANS:
        raise ImageFileError(f"has {count} scans, at most {_MOST_SCANS} are read; save it anew")


def opened(data: bytes) -> PIL.Image.Image:
    """Image by Pillow; a JPEG is decoded, and has as many coded blocks as its image.

    Data after all of them make no difference to it. **Errors**: ValueError if they do.
    """
    image = PIL.Image.open(io.BytesIO(data))
    if kind_of_start(data[:8]) == "jpeg":
        begin, _, end = data.rpartition(_JPEG_END)
        more = begin + b"\x55\x3a" * 32 + _JPEG_END + end
        if image.tobytes() != PIL.Image.open(io.BytesIO(more)).tobytes():
            raise ValueError("its data end before its image")
    return image


def tiff_pages(file: tifffile.TiffFile) -> list[tifffile.TiffPage]:
    """Images of a TIFF without previews of lower resolution, no part of them missing.

    **Errors**: ImageFileError for others, and too many.
    """
    pages = [page.aspage() for page in itertools.islice(file.pages, _MOST_PAGES + 1)]
    if len(pages) > _MOST_PAGES:
        raise ImageFileError(f"holds over {_MOST_PAGES} images; give several files")
    whole = [page for page in pages if not page.is_reduced] or pages[:1]
    if not whole:
        raise ImageFileError("is cut short: the TIFF holds no image")
    for page in whole:
        _check_page(page, file.filehandle)
    return whole


def _tiff_size(file: Any) -> tuple[int, int]:
    with contextlib.closing(tifffile.TiffFile(file)) as tiff:
        pages = tiff_pages(tiff)
    return max(p.imagewidth * p.imagelength for p in pages), sum(page.nbytes for page in pages)


def _check_page(page: tifffile.TiffPage, file: Any) -> None:
    """Refuse strips beyond the file's end, missing ones, which read as zeros, and larger ones."""
    if page.size == 0:
        raise ImageFileError("holds an empty image; give one with pixels")
    if (packing := page.compression) in tifffile.TIFF.IMAGE_COMPRESSIONS - {6, 7}:
        name = getattr(packing, "name", packing)
        raise ImageFileError(f"is packed as {name}; save it with LZW or without compression")
    strips = list(zip(page.dataoffsets, page.databytecounts, strict=True))
    short = len(strips) < math.prod(page.chunked)
    if short or any(not n or not at or at + n > file.size for at, n in strips):
        raise ImageFileError("is cut short: a part of the TIFF's pixels is missing")
    if packing == 1 and isinstance(page.bitspersample, int):
        if sum(count for _, count in strips) < page.size * page.bitspersample // 8:
            raise ImageFileError("is damaged: the TIFF has fewer pixels than it announces")
    for place, count in strips if packing in (6, 7) else ():
        file.seek(place)
        part = file.read(count)
        size = math.prod(PIL.Image.open(io.BytesIO(part)).size)
        if size > math.prod(page.chunks[:2]) or _JPEG_END not in part[-8:]:
            raise ImageFileError("is damaged: a part of the TIFF is not of its image's size")


def _check_raw(data: bytes) -> None:
    """Raw files that are TIFF hold all of their strips: LibRaw makes up the last bytes."""
    with contextlib.suppress(tifffile.TiffFileError), tifffile.TiffFile(io.BytesIO(data)) as file:
        for page in itertools.islice(file.pages, _MOST_PAGES):
            for one in (page, *(page.aspage().pages or ())):
                strips = zip(one.dataoffsets, one.databytecounts, strict=True)
                if any(place + count > len(data) for place, count in strips):
                    raise ValueError("a part of its pixels is missing")


_SIZES = {"png": _png_size, "jpeg": _jpeg_size, "tiff": _tiff_size, "npy": _npy_size}
_CHECKS: dict[Any, Any] = {"png": _check_png, "jpeg": _check_jpeg, "raw": _check_raw}
