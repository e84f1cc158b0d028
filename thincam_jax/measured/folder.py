"""The captures of a folder."""

import os
import re
from collections import Counter
from pathlib import Path

from thincam_jax.measured.raw import CaptureFileError
from thincam_jax.measured.read import read_image

SUFFIXES = (".tif", ".tiff", ".png", ".npy")


def list_captures(folder: str | os.PathLike[str], bits: int | None = None) -> list[Path]:
    """The image files of a folder, by name, with numbers in the order of their values.

    Files with the suffixes .tif, .tiff, .png and .npy, hidden ones and folders left out. Every one
    is read, with `bits` as in `read_image`, so that a long computation does not stop at a damaged
    one.

    **Errors**: CaptureFileError, one line, for no such folder, no images in it, a file that cannot
    be read, or an image of another shape than most.
    """
    folder = Path(folder)
    try:
        entries = list(folder.iterdir())
    except OSError as error:
        raise CaptureFileError(
            f"{folder}: cannot be read as a folder ({error.strerror}); give a folder of captures"
        ) from None
    paths = [p for p in entries if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")]
    paths = sorted((p for p in paths if not p.is_dir()), key=_order)
    if not paths:
        raise CaptureFileError(
            f"{folder}: holds no capture; give a folder of {', '.join(SUFFIXES)} files"
        )
    shapes = {path: read_image(path, bits).pixels.shape for path in paths}
    common, _ = Counter(shapes.values()).most_common(1)[0]
    for path, shape in shapes.items():
        if shape != common:
            same = next(p for p, s in shapes.items() if s == common)
            raise CaptureFileError(
                f"{path}: has shape {shape}, others, as {same.name}, have {common}; captures of "
                "one folder must be of one shape: take it out"
            )
    return paths


def _order(path: Path) -> tuple[list[tuple[int, str]], str]:
    """capture_9 before capture_10."""
    parts = re.split(r"([0-9]+)", path.name)
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in parts], path.name
