"""Files that are written whole or not at all, and read only where their size is known."""

import contextlib
import errno
import hashlib
import io
import json
import os
import re
import stat
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax._core.text import escaped

_PHOTOGRAPHS = (".png", ".jpg", ".jpeg", ".tif", ".tiff")


class MeasurementError(ValueError):
    """A measurement that cannot be used; one line says what was given and what to do."""

    def __str__(self) -> str:
        return escaped(super().__str__())  # a name may hold marks that a terminal obeys


class TooLargeError(ValueError):
    """A file or a document that is larger than is read; one line without its name."""


class WriteError(OSError):
    """A file that could not be written, as on a full disk, in one line."""

    def __str__(self) -> str:
        advice = _ADVICE.get(self.errno or 0, "give another folder")
        return (
            f"{self.filename}: cannot be written ({self.strerror}); {advice}; what was written "
            "before is kept"
        )


@contextlib.contextmanager
def writing(path: str | os.PathLike[str]) -> Iterator[None]:
    """WriteError, one line with this path, for refusals of the system within."""
    try:
        yield
    except OSError as error:
        raise WriteError(error.errno, error.strerror or str(error), str(path)) from error


def write_whole(
    path: str | os.PathLike[str], content: bytes | str, *, on_disk: bool = False
) -> Path:
    """Write a new file of another name beside it and rename that; text as UTF-8.

    After an error or Ctrl-C the old file is untouched and no partial one is left. `on_disk`: the
    content has reached the disk before it takes the name, so that a power cut leaves one of both.

    **Errors**: WriteError, one line, for what the system refuses.
    """
    path = Path(path)
    partial = path.with_name(f".{os.urandom(8).hex()}.partial")
    data = content.encode("utf-8") if isinstance(content, str) else content
    try:
        with writing(path):
            with open(partial, "xb") as file:  # exclusively, hence never by a link
                file.write(data)
                if on_disk:
                    file.flush()
                    os.fsync(file.fileno())
            os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    return path


@contextlib.contextmanager
def open_regular(path: str | os.PathLike[str]) -> Iterator[tuple[io.BufferedReader, int]]:
    """A regular file, open, and its size in bytes; OSError for a device, a pipe or another."""
    # Without waiting for the other end, should it be a pipe.
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | _NO_WAIT)) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "a device or a pipe, no regular file", str(path))
        yield file, status.st_size


def read_regular(path: str | os.PathLike[str], most: int | None = None) -> bytes:
    """All bytes of a regular file, as many as it is known to hold before.

    **Errors**: OSError for a device, a pipe or what cannot be opened; TooLargeError for more bytes
    than `most`; MemoryError, one line, where it does not fit.
    """
    with open_regular(path) as (file, size):
        if most is not None and size > most:
            raise TooLargeError(f"holds {size} bytes, at most {most} are read; give a smaller file")
        if size > _SMALL:
            refuse_if_too_large(str(path), size, "give a smaller file")
        return file.read(size)


def file_digest(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a regular file, in parts; OSError as of `open_regular`."""
    with open_regular(path) as (file, _):
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_json(path: str | os.PathLike[str]) -> Any:
    """Content of a JSON file. **Errors**: OSError; ValueError for another file."""
    try:
        return json.loads(read_regular(path, _MOST_JSON))
    except RecursionError:
        raise ValueError("nested too deeply") from None


def read_arrays(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Arrays of an .npz file as `numpy.savez` writes it; errors of many kinds for others."""
    with open_regular(path) as (content, size):
        if any(entry.compress_type for entry in zipfile.ZipFile(content).infolist()):
            raise ValueError("its arrays are packed")
        refuse_if_too_large(str(path), size, "give a smaller file")
        with np.load(content, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}


_MOST_JSON = 2**24  # bytes
_SMALL = 2**20  # bytes that are read without asking for the memory
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_ADVICE = dict.fromkeys(_FULL, "make room or give another folder")
_ADVICE[errno.ENOENT] = "make its folder first, or give another"
_NO_WAIT = getattr(os, "O_NONBLOCK", 0)  # not on every system


def natural_order(path: Path) -> tuple[list[tuple[int, str]], str]:
    """Key by which capture_9 comes before capture_10."""
    parts = re.split(r"([0-9]+)", path.name)
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in parts], path.name


def photograph_files(folder: str | os.PathLike[str]) -> list[Path]:
    """Files of photographs in a folder, in natural order, no hidden ones; ValueError for none."""
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"{str(folder)!r} is no folder; give a folder of images")
    there = (one for one in folder.iterdir() if one.suffix.lower() in _PHOTOGRAPHS)
    files = sorted((one for one in there if one.name[0] != "."), key=natural_order)
    if not files:
        known = ", ".join(_PHOTOGRAPHS)
        raise ValueError(f"{str(folder)!r} holds no image; give a folder of {known}")
    return files
