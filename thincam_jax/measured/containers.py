"""Arrays in files of other programs: NPZ, MATLAB, HDF5, FITS and PGM; packed raw frames.

A file of several arrays is given as FILE:KEY. No more is unpacked than that array, whose size
is checked before.
"""

import contextlib
import io
import math
import os
import re
import zipfile
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import scipy.io
from jaxtyping import UInt8, UInt16

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.files import MeasurementError, read_regular
from thincam_jax._core.image_files import ImageFileError
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax.measured.raw import CaptureFileError

_Arrays = dict[str, tuple[int, Callable[[], Any]]]  # bytes of each, and what reads it
_MOST_BYTES = 2**31  # of a packed file
_BARE = re.compile(
    r"(?i)(.+\.(?:raw(8|10|12|16)?|bin)):(\d{1,6})[x×](\d{1,6})(?:[x×](8|10|12|16))?"
)
_SWAPPED = 0.6  # of that difference, if the other order is right
_GROUPS = {8: 1, 10: 4, 12: 2, 16: 1}  # pixels that share whole bytes, of so many bits


def read_array(kind: str, data: bytes, key: str | None) -> np.ndarray:
    """The array of a key, or the only one. **Errors**: ImageFileError, which names the keys."""
    with contextlib.ExitStack() as opened:
        arrays = OPENERS[kind](data, opened)
        names = ", ".join(arrays) or "no array of numbers"
        if not arrays:
            raise ImageFileError(f"holds {names}; save the image by its own name, not in a struct")
        if key is None and len(arrays) != 1:
            raise ImageFileError(f"holds {names}; give one of them as FILE:KEY")
        if key is not None and key not in arrays:
            raise ImageFileError(f"has no {key!r}; it holds {names}")
        size, read = arrays[next(iter(arrays)) if key is None else key]
        refuse_if_too_large("its array", size, "give a smaller one")
        array = np.asarray(read())
        return array[0] if array.ndim == 3 and len(array) == 1 else array


def _open_npz(data: bytes, opened: contextlib.ExitStack) -> _Arrays:
    file = opened.enter_context(np.load(io.BytesIO(data), allow_pickle=False))
    sizes = {i.filename: i.file_size for i in zipfile.ZipFile(io.BytesIO(data)).infolist()}
    return {n: (sizes.get(f"{n}.npy", 0), lambda n=n: file[n]) for n in file.files}


def _open_matlab(data: bytes, _: contextlib.ExitStack) -> _Arrays:
    stream, names = io.BytesIO(data), ("char", "cell", "struct", "object", "function", "opaque")
    listed = [(n, shape) for n, shape, kind in scipy.io.whosmat(stream) if kind not in names]
    found = [(n, shape) for n, shape in listed if math.prod(shape) > 1]  # no exposure time
    load = partial(scipy.io.loadmat, stream)
    return {n: (8 * math.prod(s), lambda n=n: load(variable_names=[n])[n]) for n, s in found}


def _open_hdf5(data: bytes, opened: contextlib.ExitStack, transposed: bool = False) -> _Arrays:
    """Datasets in the file itself; MATLAB's first axis is the last of HDF5."""
    h5py = _library("h5py", "'thincam_jax[containers]'")
    file, arrays = opened.enter_context(h5py.File(io.BytesIO(data), "r")), {}

    def visit(name: str, one: Any) -> None:  # follows no links
        inside = isinstance(one, h5py.Dataset) and not (one.external or one.is_virtual)
        if inside and one.dtype.kind in "fiu" and one.ndim > 1 and name[:1] != "#":
            arrays[name] = one.nbytes, lambda: one[()].T if transposed else one[()]

    file.visititems(visit)
    return arrays


def _open_fits(data: bytes, opened: contextlib.ExitStack) -> _Arrays:
    fits = _library("astropy.io.fits", "astropy")
    parts = opened.enter_context(fits.open(io.BytesIO(data), memmap=False))
    images = {part.name or str(n): part for n, part in enumerate(parts) if part.is_image}
    sized = {n: (8 * math.prod(p.shape), p) for n, p in images.items() if len(p.shape) > 1}
    return {n: (size, lambda p=p: p.data) for n, (size, p) in sized.items()}


def _library(name: str, package: str) -> Any:
    try:
        return __import__(name, fromlist=["_"])
    except ImportError:
        raise ImageFileError(f"is read by {name}: pip install {package}") from None


OPENERS = {
    **{"npz": _open_npz, "mat": _open_matlab, "hdf5": _open_hdf5, "fits": _open_fits},
    "mat73": partial(_open_hdf5, transposed=True),
}


def read_pgm(data: bytes) -> tuple[list[np.ndarray], dict[str, Any]]:
    """Counts of a binary PGM or PPM of up to 16 bit, and the bits of its largest count."""
    head = re.match(rb"P([56])" + 3 * rb"(?:\s|#[^\n]*\n)+(\d{1,9})" + rb"\s", data)
    if head is None:
        raise ImageFileError("is cut short: it has no header of PGM")
    columns, rows, largest = (int(part) for part in head.groups()[1:])
    shape = (rows, columns) if head[1] == b"5" else (rows, columns, 3)
    stored = np.dtype(">u2" if largest > 255 else "u1")
    held = len(data) - head.end()
    if held < math.prod(shape) * stored.itemsize or not 0 < largest < 2**16:
        raise ImageFileError(f"is damaged: {held} bytes are no {shape} counts up to {largest}")
    pixels = np.frombuffer(data, stored, math.prod(shape), head.end()).reshape(shape)
    bits = max(8, largest.bit_length())
    return [pixels.astype(stored.newbyteorder("="))], {"bits": bits}


@checked
def unpack_raw(
    path: str | os.PathLike[str], shape: tuple[int, int], bits: int | None = None
) -> UInt8[np.ndarray, "y x"] | UInt16[np.ndarray, "y x"]:
    """Counts of a frame without a header: of 8 or 16 bit, or packed as raw10 or raw12 (MIPI CSI-2).

    - `shape`: rows and columns; bytes that pad the rows are left out. `bits`: 8, 10, 12 or 16
      (little-endian); None: those of a file without such bytes.

    Four pixels of 10 bit are four bytes of their upper bits and one of the lower ones, the first
    pixel's lowest; two of 12 bit are two bytes and one, as of a Raspberry Pi.

    **Errors**: MeasurementError for other bits, and a file of another size.
    """
    rows, columns = checks.shape2d("shape", shape)
    if bits not in (None, *_GROUPS):
        raise MeasurementError(f"bits = {bits}; give 8, 10, 12 or 16")
    data = np.frombuffer(read_regular(path, _MOST_BYTES), np.uint8)
    stride = len(data) // rows
    needed = {n: -(-columns // size) * (size * n // 8) for n, size in _GROUPS.items()}
    fitting = [
        n for n, one in needed.items() if one == stride or (n == bits and stride < one + 256)
    ]
    kept = bits or next(iter(fitting), None)
    if len(data) % rows or kept not in fitting or stride < needed[kept]:
        said = "8, 10, 12 or 16" if bits is None else f"{bits}"
        more = "; give bits if rows are padded" if bits is None else ""
        text = f"{len(data)} bytes are no {rows}×{columns} of {said} bit{more}"
        raise MeasurementError(f"{path}: {text}")
    lines = data.reshape(rows, stride)[:, : needed[kept]]
    if kept in (8, 16):
        return lines.copy() if kept == 8 else np.ascontiguousarray(lines).view("<u2")
    return unpacked(lines, columns, kept)


def read_bare(text: str) -> tuple[np.ndarray, dict[str, Any]] | None:
    """Counts of "file.raw10:480x640" or "file.raw:480x640x12", and their bits; None for others.

    Bits that are not given are those of the name, or of the size.

    **Errors**: CaptureFileError for a file that cannot be read, or of another size.
    """
    named = _BARE.fullmatch(text)
    if named is None:
        return None
    name, known, rows, columns, given = named.groups()
    bits = int(given or known or 0) or None
    shape, turned = (int(rows), int(columns)), (int(columns), int(rows))
    try:
        found = unpack_raw(name, shape, bits)
        other = np.zeros((0, 0))
        with contextlib.suppress(MeasurementError):  # as a width and a height, if those fit as well
            other = unpack_raw(name, turned, bits)
    except OSError as error:
        raise CaptureFileError(f"{name}: cannot be read ({error.strerror or error})") from None
    except ValueError as error:
        raise CaptureFileError(str(error)) from None
    if _unlike(other) < _SWAPPED * _unlike(found):
        text = f"{name}: rows of {rows}x{columns} differ as of another width"
        raise CaptureFileError(f"{text}; give rows, then columns: {columns}x{rows}")
    return found, {"bits": bits} if bits else {}


def _unlike(image: np.ndarray) -> float:
    """Mean difference of pixels to the second ones below them, of one colour."""
    return float(np.abs(image[2:].astype(float) - image[:-2]).mean()) if len(image) > 2 else np.inf


def unpacked(
    rows: UInt8[np.ndarray, "y stride"], columns: int, bits: int
) -> UInt16[np.ndarray, "y x"]:
    """Counts of packed rows of 10 or 12 bit, without the bytes that pad them; see `unpack_raw`."""
    group = 4 if bits == 10 else 2
    groups = -(-columns // group)
    packed = rows[:, : groups * (group + 1)].reshape(len(rows), groups, group + 1)
    low, shifts = packed[..., -1:].astype(np.uint16), (bits - 8) * np.arange(group, dtype=np.uint16)
    high = packed[..., :-1].astype(np.uint16) << (bits - 8)
    counts = high | (low >> shifts) & (2**bits // 256 - 1)
    return counts.reshape(len(rows), -1)[:, :columns]
