"""Layouts of binary masks for lithography, as GDSII files."""

import math
import os
import tempfile
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np

from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number
from thincam_jax._core.files import read_regular, write_whole
from thincam_jax._core.quantity import choice, quantity, whole
from thincam_jax.lensless.masks.base import AbstractFactoredMask, AbstractMask
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.lensless.masks.openings import RadialMask
from thincam_jax.lensless.mosaic import Mosaic

Tone = Literal["open", "opaque"]
TONES: tuple[Tone, ...] = get_args(Tone)
# µm a mm; µm by which a polygon may miss a circle, and of the file's database unit.
_MICROMETRES, _CHORD, _UNIT = 1e3, 0.01, 1e-3
_HALFTONE = "its tc.lensless.masks.halftone.halftone(mask, cell)"


@checked
def write_gds(
    path: str | os.PathLike[str],
    mask: AbstractMask | Mosaic,
    *,
    tone: Annotated[Tone, choice(TONES)] = "open",
    layer: Annotated[int, whole(0, 255)] = 1,
    cell: str = "MASK",
    smallest_feature: Annotated[Number | None, quantity("mm", positive=True, optional=True)] = None,
) -> Path:
    """Write a binary mask as polygons for a mask shop: GDSII, in µm, to 1 nm.

    Masks of cells that are open or closed (`SampledMask`, MURA, URA, separable, `Pinhole`), rings
    (`RadialMask`) and the binary `FresnelZoneAperture`, whose zones are cut off by its sides as
    they are, without the Fourier series of the model. A grey mask is written as its
    `lensless.masks.halftone.halftone(mask, cell)`. x points right and y up: rows of the mask run
    downwards, as in its picture. Circles are polygons within 10 nm. A `Mosaic` is one layout of all
    its masks at their places.

    **Arguments**

    - `tone`: parts that are drawn, the open ones or, within the mask's extent, the opaque ones;
      slow for 10⁵ cells and more.
    - `layer`, `cell`: number of the layer, of data type 0, and name of the cell.
    - `smallest_feature`: the finest line that can be written, mm: a mask with a finer open or
      opaque part is refused. Along rows, columns and radii; corners are not measured.

    **Errors**: TypeError for a mask without such a layout; ValueError for grey and phase masks, for
    a suffix that is not .gds and for features that are too fine; ImportError without gdstk
    (`pip install 'thincam_jax[layout]'`).

    ```python
    import thincam_jax as tc
    from thincam_jax.units import um

    mask = tc.ModifiedUniformlyRedundantArray(11, cell=30 * um)
    tc.design.write_gds("mura.gds", mask, smallest_feature=2 * um)
    ```

    **See also**: `lensless.masks.halftone.halftone`, `write_stl`, `write_height_map`.
    """
    try:
        import gdstk  # an extra
    except ImportError:
        raise ImportError("layouts need gdstk: pip install 'thincam_jax[layout]'") from None
    path = Path(path)
    if path.suffix.lower() != ".gds":
        raise ValueError(f"{path}: layouts are written as .gds; give this suffix")
    masks = mask.placed if isinstance(mask, Mosaic) else (mask,)
    drawings = [_drawing(gdstk, one) for one in masks]
    parts = [part for drawn, _ in drawings for part in drawn]
    finest = min(width for _, width in drawings)
    least = 0.0 if smallest_feature is None else float(np.asarray(smallest_feature))
    if finest < least - _UNIT / _MICROMETRES / 2:
        raise ValueError(
            f"the mask's finest part is {finest * _MICROMETRES:.3g} µm wide; give a coarser mask, "
            f"or smallest_feature of at most {finest:.3g} mm"
        )
    if tone == "opaque":
        corners = np.stack([_frame(gdstk, one).bounding_box() for one in masks])
        whole = gdstk.rectangle(corners[:, 0].min(axis=0), corners[:, 1].max(axis=0))
        parts = gdstk.boolean(whole, parts, "not", precision=_UNIT)
    library = gdstk.Library(unit=1e-6, precision=1e-9)
    drawn = library.new_cell(cell)
    for part in parts:
        part.layer = layer
        drawn.add(part)
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / path.name
        library.write_gds(written)
        return write_whole(path, read_regular(written))


def _drawing(gdstk: Any, mask: AbstractMask) -> tuple[list, float]:
    """Polygons of the open parts, and the finest part, mm."""
    zones = _zones(mask)
    return _cells(gdstk, mask) if zones is None else _rings(gdstk, mask, *zones)


def _frame(gdstk: Any, mask: AbstractMask) -> Any:
    height, width = (float(side) * _MICROMETRES for side in mask.extent)
    y, x = _centre(mask)
    return gdstk.rectangle((x - width / 2, y - height / 2), (x + width / 2, y + height / 2))


def _centre(mask: AbstractMask) -> tuple[float, float]:
    """(y, x) in µm, y upwards."""
    down, right = (float(c) * _MICROMETRES for c in np.asarray(mask.centre))
    return -down, right


def _zones(mask: AbstractMask) -> tuple[np.ndarray, bool] | None:
    """Radii at which a mask of zones changes, mm, and whether its middle is open; else None."""
    if isinstance(mask, RadialMask):
        values = _binary(np.asarray(mask.rings, float))
        changes = np.flatnonzero(np.diff(values, append=0))
        return np.asarray(mask.radii, float)[changes], bool(values[0])
    if not isinstance(mask, FresnelZoneAperture) or mask.pixels is not None:
        return None
    if mask.profile != "binary":
        raise ValueError(
            f"a zone aperture of the profile {mask.profile!r} is grey; give 'binary', or "
            f"{_HALFTONE}"
        )
    beta, phase = float(mask.beta), float(mask.phase)
    farthest = beta * sum((float(side) / 2) ** 2 for side in mask.extent) + phase
    # The cosine changes its sign at odd multiples of π/2.
    first, last = np.ceil(phase / np.pi - 0.5), np.ceil(farthest / np.pi - 0.5)
    turns = (np.arange(first, last) + 0.5) * np.pi
    radii = np.sqrt((turns - phase) / beta)
    return radii[radii > 0], bool(np.cos(phase + 1e-9) > 0)


def _rings(gdstk: Any, mask: AbstractMask, radii: np.ndarray, middle: bool) -> tuple[list, float]:
    y, x = _centre(mask)
    edges = np.concatenate([[0.0], radii, [math.hypot(*map(float, mask.extent))]])
    rings = [
        gdstk.ellipse(
            (x, y),
            outer * _MICROMETRES,
            inner_radius=inner * _MICROMETRES or None,
            tolerance=_CHORD,
        )
        for number, (inner, outer) in enumerate(zip(edges[:-1], edges[1:], strict=True))
        if (number % 2 == 0) == middle
    ]
    parts = gdstk.boolean(rings, _frame(gdstk, mask), "and", precision=_UNIT)
    # Beyond the last radius the sides cut off what is left: parts of any size.
    widths = [2 * edges[1], *np.diff(edges[1:-1])]
    return parts, float(min(widths))


def _cells(gdstk: Any, mask: AbstractMask) -> tuple[list, float]:
    """Rectangles of open cells, equal runs of rows joined, and the shortest run of cells, mm."""
    if not isinstance(mask, AbstractFactoredMask):
        raise TypeError(
            f"a {type(mask).__name__} has no layout of polygons; give a binary mask of cells, "
            "rings or zones"
        )
    if isinstance(mask, FresnelZoneAperture):
        raise TypeError("a display shows the zones in its pixels; leave out pixel_pitch")
    terms = mask.terms()
    rows, columns = (np.asarray(f.values) for f in (terms.rows, terms.columns))
    values = (np.asarray(terms.coefficients)[:, None] * rows).T @ columns
    cells = _binary(values).astype(bool)
    down, right = (
        (np.asarray(factors.edges, float) + float(middle)) * _MICROMETRES
        for factors, middle in zip(
            (terms.rows, terms.columns), np.asarray(mask.centre), strict=True
        )
    )
    rectangles, begun = [], {}  # first row of the runs that go on
    for i, row in enumerate([*cells, np.zeros_like(cells[0])]):
        runs = dict.fromkeys(zip(*_ends(row), strict=True), i)
        for run in begun.keys() - runs.keys():
            first, end = run
            corners = (right[first], -down[begun.pop(run)]), (right[end], -down[i])
            rectangles.append(gdstk.rectangle(*corners))
        begun = runs | begun
    finest = min(_shortest(cells, right), _shortest(cells.T, down)) / _MICROMETRES
    return rectangles, finest


def _ends(row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First cells of the runs of open ones, and those behind them."""
    steps = np.diff(row.astype(int), prepend=0, append=0)
    return np.flatnonzero(steps > 0), np.flatnonzero(steps < 0)


def _shortest(lines: np.ndarray, edges: np.ndarray) -> float:
    """The shortest open or closed run along any line; one at an end counts if it is open."""
    lengths = [np.inf]
    for line in lines:
        starts, stops = _ends(line)
        lengths += [*(edges[stops] - edges[starts]), *(edges[starts[1:]] - edges[stops[:-1]])]
    return float(min(lengths))


def _binary(values: np.ndarray) -> np.ndarray:
    found = np.round(np.real(values))
    if np.abs(values - found).max() > 1e-6 or not np.isin(found, (0, 1)).all():
        raise ValueError(
            "the mask has grey or complex parts; give transmittances of 0 and 1, or, of a grey "
            f"one, {_HALFTONE}"
        )
    return found
