r"""Files of phase masks: 8-bit height maps with their scale, and solids for writing them."""

import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from thincam_jax._core import checks
from thincam_jax._core.checks import Number
from thincam_jax._core.files import MeasurementError, read_json, write_whole
from thincam_jax.imaging.encoding import png_bytes
from thincam_jax.imaging.refractive_index import (
    AbstractIndex,
    CauchyIndex,
    ConstantIndex,
    SellmeierIndex,
)
from thincam_jax.lensless.masks.phase import PhaseMask
from thincam_jax.measured.read import read_image
from thincam_jax.measured.write import log_text

_COUNTS = 255
_KINDS = {"constant": ConstantIndex, "cauchy": CauchyIndex, "sellmeier": SellmeierIndex}
_FORMAT = "thincam_jax height map 1"
# Of a cell's side: what its walls take of it. A wall that stands upright meets four cells in an
# edge, and where two of them are high and two low, that edge would have four faces.
_WALL = 0.01
_FACET = np.dtype([("numbers", "<f4", 12), ("attribute", "<u2")])


def write_height_map(path: str | os.PathLike[str], mask: PhaseMask, *, wavelength: Number) -> Path:
    """Write the heights as an 8-bit grey PNG, and what its counts mean beside it as NAME.json.

    Of the JSON: `height_per_count_mm` (a count of 0 is the lowest, 0), `pitch_mm`, `material`,
    `interpolation`, `centre_mm`, and the `wavelength_mm` that it was designed for with the index
    there. Heights are rounded to half a count. `read_height_map` is the way back.

    **Errors**: ValueError for a suffix that is not .png and for a mask with an amplitude; OSError
    where nothing can be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ValueError(f"{path}: height maps are written as .png; give this suffix")
    if mask.amplitude is not None:
        raise ValueError("a height map holds no amplitude; write a mask whose amplitude is None")
    height = np.asarray(mask.height, float)
    per_count = height.max() / _COUNTS if height.max() > 0 else 1e-6
    light = checks.wavelength("wavelength", wavelength)
    record = {
        "format": _FORMAT,
        "height_per_count_mm": float(per_count),
        "pitch_mm": float(mask.pitch),
        "centre_mm": [float(c) for c in mask.centre],
        "interpolation": mask.interpolation,
        "material": _described(mask.material),
        "wavelength_mm": float(light),
        "index_at_wavelength": float(mask.material(light)),
        "shape": list(height.shape),
    }
    write_whole(path.with_suffix(".json"), log_text(record))
    return write_whole(path, png_bytes(np.round(height / per_count).astype(np.uint8)))


def read_height_map(path: str | os.PathLike[str]) -> PhaseMask:
    """The mask of a height map that `write_height_map` wrote.

    **Errors**: MeasurementError, one line, for a PNG that is no height map, and for a JSON file
    that is missing, or does not say what it must.
    """
    path = Path(path)
    record = _record(path.with_suffix(".json"))
    raw = read_image(path)
    if raw.pixels.dtype != np.uint8 or raw.pixels.ndim != 2:
        raise MeasurementError(
            f"{path}: has {raw.pixels.ndim} axes of {raw.pixels.dtype}; give an 8-bit grey PNG"
        )
    if list(raw.pixels.shape) != record["shape"]:
        raise MeasurementError(
            f"{path}: has {raw.pixels.shape} pixels and its JSON file says "
            f"{tuple(record['shape'])}; give the pair as it was written"
        )
    try:
        return PhaseMask(
            raw.pixels * float(record["height_per_count_mm"]),
            float(record["pitch_mm"]),
            _material(record["material"]),
            centre=tuple(map(float, record["centre_mm"])),  # pyright: ignore
            interpolation=record["interpolation"],
        )
    except (ValueError, TypeError, KeyError) as error:
        reason = str(error).splitlines()[0]
        raise MeasurementError(f"{path.with_suffix('.json')}: is no mask's ({reason})") from None


def write_stl(path: str | os.PathLike[str], mask: PhaseMask, *, base: Number = 0.1) -> Path:
    r"""Write the relief as a closed solid, binary STL in mm: a height field on a plate.

    The tops lie at z = base + h and the plate's bottom at 0, so that the volume is
    :math:`\sum h\,p^2 + \mathrm{base} \times \mathrm{area}`. Cells are flat tops joined by walls
    that take 1 % of a cell on either side; bilinear heights are joined at the cells' centres. Every
    edge belongs to two triangles. y runs down in an image and so does it here: −y is up.

    **Errors**: ValueError for a suffix that is not .stl and for a base that is not positive.
    """
    path = Path(path)
    if path.suffix.lower() != ".stl":
        raise ValueError(f"{path}: solids are written as .stl; give this suffix")
    thickness = float(checks.positive("base", base, "mm"))
    y, x, z = _surface(mask)
    triangles = _solid(-y, x, z + thickness)
    facets = np.zeros(len(triangles), _FACET)
    facets["numbers"][:, :3] = _normals(triangles)
    facets["numbers"][:, 3:] = triangles.reshape(-1, 9)
    head = b"thincam_jax phase mask, mm".ljust(80)
    return write_whole(path, head + np.uint32(len(facets)).tobytes() + facets.tobytes())


def _surface(mask: PhaseMask):
    """Lines y and x of vertices, mm, and the heights where they cross."""
    height, pitch = np.asarray(mask.height, float), float(mask.pitch)
    cells = mask.interpolation == "cells"
    axes, places = [], []
    for count, centre in zip(height.shape, np.asarray(mask.centre, float), strict=True):
        if cells:
            inset = np.where(np.arange(count) > 0, _WALL, 0.0), np.full(count, 1.0)
            inset[1][:-1] -= _WALL
            at = np.stack([np.arange(count) + i for i in inset], axis=1).ravel()
            places.append(np.repeat(np.arange(count), 2))
        else:
            at = np.concatenate([[0.0], np.arange(count) + 0.5, [float(count)]])
            places.append(np.concatenate([[0], np.arange(count), [count - 1]]))
        axes.append((at - count / 2) * pitch + centre)
    return axes[0], axes[1], height[np.ix_(*places)]


def _solid(
    y: Float64[np.ndarray, " n"], x: Float64[np.ndarray, " m"], z: Float64[np.ndarray, "n m"]
) -> Float32[np.ndarray, "triangle 3 3"]:
    """Triangles of the block below a height field, (x, y, z), counter-clockwise from outside.

    y falls.
    """
    grid = np.stack(np.broadcast_arrays(x, y[:, None], z), axis=-1)
    floor = grid * [1, 1, 0]
    tops = _triangles(grid, fan=True)
    sides = [
        _strip(grid[0], floor[0]),
        _strip(grid[-1, ::-1], floor[-1, ::-1]),
        _strip(grid[::-1, 0], floor[::-1, 0]),
        _strip(grid[:, -1], floor[:, -1]),
    ]
    bottom = _triangles(floor, fan=False)[:, ::-1]
    # y falls along the rows: seen from above, (a, b, c) of `_triangles` is clockwise.
    return np.concatenate([tops, *sides, bottom])[:, ::-1].astype(np.float32)


def _triangles(grid: np.ndarray, *, fan: bool) -> np.ndarray:
    """Triangles of each quadrangle: two where it is plane, else four around its corners' mean.

    Then the volume below is that of the bilinear surface, exactly.
    """
    a, b = grid[:-1, :-1].reshape(-1, 3), grid[:-1, 1:].reshape(-1, 3)
    d, c = grid[1:, :-1].reshape(-1, 3), grid[1:, 1:].reshape(-1, 3)
    twisted = np.abs((a + c - b - d)[:, 2]) > 0 if fan else np.zeros(len(a), bool)
    flat = ~twisted
    plane = [np.stack(t, axis=1)[flat] for t in ((a, b, c), (a, c, d))]
    m = (a + b + c + d) / 4
    around = [np.stack(t, axis=1)[twisted] for t in ((a, b, m), (b, c, m), (c, d, m), (d, a, m))]
    return np.concatenate([*plane, *around])


def _strip(top: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """A side: from the rim's vertices down to the floor's."""
    one = np.stack([top[1:], top[:-1], floor[:-1]], axis=1)
    other = np.stack([top[1:], floor[:-1], floor[1:]], axis=1)
    return np.concatenate([one, other])


def _normals(triangles: np.ndarray) -> np.ndarray:
    first, second, third = (triangles[:, i].astype(float) for i in range(3))
    normal = np.cross(second - first, third - first)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)


def _described(material: AbstractIndex) -> dict[str, Any]:
    for kind, made in _KINDS.items():
        if type(material) is made:
            numbers = {k: np.asarray(v).tolist() for k, v in vars(material).items() if k != "band"}
            return {"kind": kind, **numbers, "band_mm": list(material.band)}
    raise ValueError(
        f"material is a {type(material).__name__}; files hold a constant, Cauchy or Sellmeier index"
    )


def _material(record: dict[str, Any]) -> AbstractIndex:
    numbers = {k: np.asarray(v) for k, v in record.items() if k not in ("kind", "band_mm")}
    if record["kind"] == "constant":
        return ConstantIndex(**numbers)
    low, high = record["band_mm"]
    return _KINDS[record["kind"]](**numbers, band=(float(low), float(high)))


def _record(path: Path) -> dict[str, Any]:
    if not path.exists():
        raise MeasurementError(
            f"{path}: is missing; a height map is a PNG with the JSON file that says what its "
            "counts mean"
        )
    try:
        record = read_json(path)
        known = record["format"] == _FORMAT and len(record["shape"]) == 2
    except (OSError, ValueError, KeyError, TypeError):
        record, known = {}, False
    if not known:
        raise MeasurementError(f"{path}: is no height map's; give one of write_height_map")
    return record
