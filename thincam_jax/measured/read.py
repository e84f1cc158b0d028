"""Image files: TIFF, PNG and NPY, told apart by their first bytes and not by their names."""

import io
import os
import warnings
from pathlib import Path

import numpy as np

from thincam_jax.measured._png import read_png
from thincam_jax.measured._tiff import read_tiff
from thincam_jax.measured.raw import CaptureFileError, MeasurementError, Raw

_STARTS = {
    b"\x89PNG\r\n\x1a\n": "png",
    b"\x93NUMPY": "npy",
    b"II*\0": "tiff",
    b"MM\0*": "tiff",
    b"II+\0": "tiff",  # BigTIFF: more than 4 GB
    b"MM\0+": "tiff",
}


def read_image(path: str | os.PathLike[str], bits: int | None = None) -> Raw:
    """One measured image as it is stored: nothing scaled, no gamma undone, no channel dropped.

    TIFF and PNG of 8 or 16 bit a sample, grey or RGB, and NPY; floats in TIFF and NPY. An alpha
    channel that hides nothing is left out. `bits` is the bit depth of the camera (see `Raw`).

    **Errors**: CaptureFileError, one line, for a file that is missing, cut short, damaged or no
    image, for a stack of images, and for all that `Raw` refuses.
    """
    path = Path(path)
    pixels, kind, found = _decode(path)
    try:
        return Raw(pixels, found if bits is None else bits, kind, str(path))
    except MeasurementError as error:
        raise CaptureFileError(str(error)) from None


def read_mask(path: str | os.PathLike[str]) -> np.ndarray:
    """A map (y, x) of pixels from a one-channel image file, True where it is not zero.

    As for a sensor's dead pixels. An NPY file may hold bool.

    **Errors**: CaptureFileError as in `read_image`.
    """
    pixels, _, _ = _decode(Path(path))
    if pixels.ndim != 2 or pixels.size == 0 or pixels.dtype.kind not in "buif":
        raise CaptureFileError(
            f"{path}: holds {pixels.dtype} values of shape {pixels.shape}; give a map (y, x) that "
            "is zero for all pixels but the marked ones"
        )
    return pixels != 0


def _decode(path: Path) -> tuple[np.ndarray, str, int | None]:
    """Pixels, format and, where the file tells it, bits a sample."""
    data = _bytes(path)
    kind = next((kind for start, kind in _STARTS.items() if data.startswith(start)), None)
    if kind is None:
        short = not data or any(start.startswith(data) for start in _STARTS)
        what = "is empty or cut short" if short else "is not an image that can be read"
        raise CaptureFileError(f"{path}: {what}; give an undamaged TIFF, PNG or NPY file")
    readers = {"png": read_png, "tiff": read_tiff, "npy": _read_npy}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the decoders; what is wrong is told below
            pixels, bits = readers[kind](data)
    except CaptureFileError as error:
        raise CaptureFileError(f"{path}: {error}") from None
    except Exception as error:  # each decoder raises its own kind
        reason = (str(error).splitlines() or [""])[0] or type(error).__name__
        raise CaptureFileError(
            f"{path}: cannot be read as {kind.upper()} ({reason}); the file is cut short, damaged "
            "or of a rare kind: copy it again or save it anew"
        ) from None
    return pixels, kind, bits


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise CaptureFileError(f"{path}: does not exist; give the path of an image") from None
    except IsADirectoryError:
        raise CaptureFileError(f"{path}: is a folder; give the path of one image") from None
    except OSError as error:
        raise CaptureFileError(f"{path}: cannot be read ({error.strerror or error})") from None


def _read_npy(data: bytes) -> tuple[np.ndarray, None]:
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    readers = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in readers:
        raise CaptureFileError(f"is NPY of version {version}; save it with numpy.save")
    shape, _, dtype = readers[version](stream)
    if dtype.hasobject or dtype.fields:
        raise CaptureFileError(f"holds {dtype} values, no image; give uint8, uint16 or float")
    # Before NumPy makes room for what a damaged header announces.
    size, held = dtype.itemsize * np.prod([int(n) for n in shape], dtype=object), len(data)
    if size > held - stream.tell():
        raise CaptureFileError(
            f"is cut short: {held - stream.tell()} of the {size} bytes of its values are there"
        )
    stream.seek(0)
    return np.load(stream, allow_pickle=False), None
