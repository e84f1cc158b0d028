"""The arrays of a pytree in a file: a line of JSON, then the arrays as NPY; never pickle.

The line holds the format, who wrote the file, a description, name, byte count and SHA-256 of each
array, and the line's own SHA-256. A file is written whole or not at all. Read it is only after
all counts and sums have been found right, so that what is announced costs no memory and a flipped
bit is reported; then dtype and shape of each array must be those of the pytree that it is to fill.
safetensors would be read elsewhere, too, but has no sums: a flipped bit of a weight would pass.
"""

import hashlib
import json
import math
import os
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from thincam_jax._core import files

FORMAT, VERSION = "thincam_jax arrays", 1
# Of the line of JSON, and of the header of an NPY array.
_LONGEST_LINE, _LONGEST_HEADER = 2**24, 2**10


class CheckpointError(ValueError):
    """A file of arrays that cannot be used; one line says what is wrong and what to do."""


def write_arrays(path: str | os.PathLike[str], tree: Any, description: dict[str, Any]) -> Path:
    """Write the arrays of a pytree, and what is to be known of them: JSON, finite numbers only."""
    named = [(name, _npy(np.asarray(leaf))) for name, leaf in _named(tree)]
    header = {
        "format": FORMAT,
        "version": VERSION,
        "written_by": {name: version(name) for name in ("thincam_jax", "jax", "numpy")},
        "description": description,
        "arrays": [[name, len(data), _sum(data)] for name, data in named],
    }
    header = json.loads(_line(header))  # tuples are lists from here on
    line = _line({**header, "sha256": _sum(_line(header))})
    content = b"".join([line, b"\n", *(data for _, data in named)])
    return files.write_whole(path, content, on_disk=True)


def read_description(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Description of a file's arrays, after all sums have been checked.

    **Errors**: CheckpointError, one line; OSError for what cannot be read.
    """
    return _read(path)[0]["description"]


def network_description(path: str | os.PathLike[str], kind: str) -> dict[str, Any]:
    """Description of a network's file of that kind: with `options`, `training`, maybe `camera`."""
    description = read_description(path)
    parts = (description.get(name, {}) for name in ("options", "training", "camera"))
    if description.get("kind") != kind or not all(isinstance(part, dict) for part in parts):
        raise CheckpointError(f"{path}: holds no {kind}; give a file that a training wrote")
    return description


def read_arrays(path: str | os.PathLike[str], like: Any) -> Any:
    """The pytree `like`, of arrays or of `jax.ShapeDtypeStruct`, with the arrays of the file.

    Floating numbers of another precision are taken and rounded to that of `like`.

    **Errors**: as of `read_description`, and CheckpointError for arrays of other names, kinds or
    shapes.
    """
    header, contents = _read(path)
    names = [name for name, _, _ in header["arrays"]]
    wanted = _named(like)
    if names != [name for name, _ in wanted]:
        raise CheckpointError(
            f"{path}: holds other arrays ({len(names)}) than are wanted here ({len(wanted)}); "
            "it belongs to another model"
        )
    pairs = zip(wanted, contents, strict=True)
    leaves = [_array(path, name, leaf, data) for (name, leaf), data in pairs]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def read_weights(path: str | os.PathLike[str], like: Any) -> Any:
    """Read weights as arrays of JAX; CheckpointError also where they are not finite."""
    weights = read_arrays(path, like)
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(weights)):
        raise CheckpointError(f"{path}: holds weights that are not finite; give an earlier file")
    return jax.tree.map(jnp.asarray, weights)


def difference(there: Any, here: Any, name: str = "") -> str | None:
    """The first number or text in which two descriptions differ, in words; None where none does.

    Numbers may differ by the rounding of single precision.
    """
    if isinstance(there, dict) and isinstance(here, dict):
        pairs = [(key, there.get(key), here.get(key)) for key in sorted({*there, *here})]
    elif isinstance(there, list) and isinstance(here, list) and len(there) == len(here):
        pairs = [(str(n), *pair) for n, pair in enumerate(zip(there, here, strict=True))]
    else:
        if there == here:
            return None
        if isinstance(there, int | float) and isinstance(here, int | float):
            if math.isclose(there, here, rel_tol=1e-6):
                return None
        return f"whose {name} was {json.dumps(there)} and is {json.dumps(here)} here"
    found = (difference(a, b, f"{name}.{key}" if name else key) for key, a, b in pairs)
    return next((words for words in found if words), None)


def _named(tree: Any) -> list[tuple[str, Any]]:
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return [(jax.tree_util.keystr(keys), leaf) for keys, leaf in leaves]


def _npy(array: np.ndarray) -> bytes:
    content = BytesIO()
    order = np.ascontiguousarray(array).reshape(array.shape)  # which makes () to (1,)
    np.lib.format.write_array(content, order, version=(1, 0), allow_pickle=False)
    return content.getvalue()


def _line(header: dict[str, Any]) -> bytes:
    """JSON in the one form that is read back."""
    text = json.dumps(header, sort_keys=True, allow_nan=False, separators=(",", ":"))
    return text.encode("ascii")


def _sum(data: bytes | memoryview) -> str:
    return hashlib.sha256(data).hexdigest()


def _read(path: str | os.PathLike[str]) -> tuple[dict[str, Any], list[memoryview]]:
    """The header, and the bytes of each array; nothing of these is interpreted yet."""
    with files.open_regular(path) as (file, size):
        line = file.readline(_LONGEST_LINE)
        header, length = _header(path, line), size - len(line)
        sound, contents = _is_sound(header, line[:-1], length), []
        rest = memoryview(file.read(length) if sound else b"")
    for _, count, digest in header["arrays"] if sound else ():
        contents.append(rest[:count])
        sound, rest = sound and _sum(contents[-1]) == digest, rest[count:]
    if not sound:
        raise CheckpointError(
            f"{path}: is damaged or cut off; copy it again or go back to an earlier one"
        )
    return header, contents


def _header(path: str | os.PathLike[str], line: bytes) -> dict[str, Any]:
    try:
        header = json.loads(line)
        known = header["format"] == FORMAT and type(header["version"]) is int
    except (ValueError, KeyError, TypeError, RecursionError):
        known, header = False, {}
    if not known:
        raise CheckpointError(f"{path}: is no file of a network; give one that a training wrote")
    if header["version"] > VERSION:
        raise CheckpointError(
            f"{path}: has format {header['version']} and this package reads {VERSION}; "
            "update thincam_jax"
        )
    return header


def _is_sound(header: dict[str, Any], line: bytes, length: int) -> bool:
    """Whether the line is as it was written, and the counts are those of the bytes behind it."""
    unsigned = {name: value for name, value in header.items() if name != "sha256"}
    try:
        whole = line == _line(header) and header["sha256"] == _sum(_line(unsigned))
        counts = [count for _, count, _ in header["arrays"]]
        whole = whole and all(type(count) is int and count >= 0 for count in counts)
        return whole and isinstance(header["description"], dict) and sum(counts) == length
    except (ValueError, KeyError, TypeError, RecursionError):
        return False


def _array(path, name: str, wanted: Any, data: memoryview) -> np.ndarray:
    """An array of the kind and shape of `wanted`, without any trust in what wrote the file."""
    stream = BytesIO(data)
    try:
        if np.lib.format.read_magic(stream) != (1, 0):
            raise ValueError("NPY of another version")
        header = np.lib.format.read_array_header_1_0(stream, max_header_size=_LONGEST_HEADER)
        shape, is_fortran, dtype = header
    except Exception as error:  # of many kinds, as NumPy takes the header for Python
        raise CheckpointError(f"{path}: {name} is no array in NPY format 1.0") from error
    kind = np.dtype(wanted.dtype)
    alike = dtype == kind or (dtype.kind == kind.kind == "f" and dtype.itemsize in (2, 4, 8))
    if dtype.hasobject or is_fortran or not alike or shape != tuple(wanted.shape):
        raise CheckpointError(
            f"{path}: {name} is {dtype}{list(shape)} and the model here has "
            f"{kind}{list(wanted.shape)}; it belongs to another model"
        )
    numbers = data[stream.tell() :]
    if len(numbers) != dtype.itemsize * int(np.prod(shape, dtype=object)):
        raise CheckpointError(f"{path}: {name} holds {len(numbers)} bytes, not those of {shape}")
    return np.frombuffer(numbers, dtype).reshape(shape).astype(kind)
