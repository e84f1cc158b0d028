"""Patterns for a display, uint8 of its shape: those of a plan, masks and cells.

Levels are proportional to the transmitted irradiance, as with the display's table of grey levels.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import skimage

from thincam_jax._core.grids import Grid
from thincam_jax.hardware.acquisition.plan import Pattern, picture_digest
from thincam_jax.lensless.masks.cells import AbstractCellMask
from thincam_jax.lensless.masks.fza import FresnelZoneAperture
from thincam_jax.measured.calibration.hadamard import HadamardSeries

_HARMONICS = 99  # of a profile's series; the rest is less than a level


def pattern_levels(
    pattern: Pattern,
    shape: tuple[int, int],
    pitch: float,
    pictures: Mapping[str, np.ndarray] | None = None,
) -> np.ndarray:
    """Levels of a pattern of a plan on a display of a shape and a pixel pitch, mm.

    - `pictures`: by name, levels of cells or pixels (row, column), as the plan was made with.

    **Errors**: as of `mask_pattern` and `on_cells`; ValueError for a pattern of another kind, and a
    picture that is not the one of the plan.
    """
    numbers: dict[str, Any] = dict(pattern.numbers)
    if pattern.kind in ("picture", "pixels"):
        levels = (pictures or {}).get(numbers["name"])
        if levels is None or picture_digest(levels) != numbers["digest"]:
            raise ValueError(f"the picture {numbers['name']!r} is not the one of the plan")
        return on_cells(levels, shape, 1 if pattern.kind == "pixels" else None)
    if pattern.kind in ("black", "uniform"):
        return np.full(shape, numbers.get("level", 0), np.uint8)
    if pattern.kind == "hadamard":
        cells, frame = (numbers.pop("rows"), numbers.pop("columns")), numbers.pop("frame")
        return on_cells(255 * HadamardSeries(cells, **numbers).frame(frame), shape)
    if pattern.kind == "mark":
        return _mark(shape, pitch, **numbers)
    if pattern.kind == "mosaic":
        return _mosaic(shape, pitch, numbers)
    if pattern.kind != "fza":
        raise ValueError(f"a pattern of kind {pattern.kind!r} has no levels; give an own `render`")
    return mask_pattern(FresnelZoneAperture(**numbers, pixel_pitch=pitch), shape, pitch)


def _mark(shape: tuple[int, int], pitch: float, x: float, y: float, size: float) -> np.ndarray:
    """A white disc about the pixel nearest to (x, y)."""
    levels, radius = np.zeros(shape, np.uint8), max(size / 2 / pitch, 0.6)
    centre = [round((n - 1) / 2 + at / pitch) for n, at in zip(shape, (y, x), strict=True)]
    if any(not radius <= at + 0.5 <= n - radius for n, at in zip(shape, centre, strict=True)):
        raise ValueError(f"a mark of {size:g} mm at {x:g}, {y:g} mm is not all on the display")
    levels[skimage.draw.disk(centre, radius)] = 255
    return levels


def _mosaic(shape: tuple[int, int], pixel: float, numbers: dict[str, Any]) -> np.ndarray:
    """Levels of zone plates side by side, each on whole pixels of the display."""
    levels = np.zeros(shape, np.uint8)
    cells, side = (numbers["rows"], numbers["columns"]), round(numbers["width"] / pixel)
    for number in range(cells[0] * cells[1]):
        middles = np.array(np.unravel_index(number, cells)) - (np.array(cells) - 1) / 2
        corner = np.array(shape) / 2 + middles * numbers["pitch"] / pixel - side / 2
        top, left = (round(float(n)) for n in corner)
        if np.abs(corner - (top, left)).max() > 1e-3 or min(top, left) < 0:
            raise ValueError(
                f"masks of {numbers['width']:g} mm, {numbers['pitch']:g} mm apart, are not on "
                f"whole pixels of a display of {shape}; give a width and a mosaic.pitch that "
                f"are an even number of {pixel:g} mm, and fit"
            )
        mask = FresnelZoneAperture(
            numbers[f"beta {number}"],
            numbers[f"phase {number}"],
            width=numbers["width"],
            profile=numbers["profile"],
            pixel_pitch=pixel,
        )
        if top + side > shape[0] or left + side > shape[1]:
            raise ValueError(f"the masks are larger than the display of {shape} pixels")
        shown = mask_pattern(mask, (side, side), pixel)
        levels[top : top + side, left : left + side] = shown
    return levels


def mask_pattern(
    mask: FresnelZoneAperture | AbstractCellMask, shape: tuple[int, int], pitch: float
) -> np.ndarray:
    """A Fresnel zone aperture or a mask of cells, centred on a black display.

    The level is 255·t², with the mask's amplitude transmittance t at each pixel's centre; a mask of
    the profile "binary" has only 0 and 255. `pitch` is that of the display's pixels in mm; their
    fill factor acts on the display itself.

    **Errors**: ValueError for zones of another pitch, cells that are not a whole number of pixels,
    and a mask that is too large or half a pixel off the grid.
    """
    sides = tuple(float(side) / pitch for side in mask.extent)
    given = None
    if isinstance(mask, AbstractCellMask):
        given = float(mask.cell) / max(1, round(float(mask.cell) / pitch))
    elif mask.pixels is not None:
        given = float(mask.extent[1]) / mask.pixels[1]
    if given is not None:
        if abs(given - pitch) > 1e-4 * pitch:
            raise ValueError(f"a mask for pixels of {given:g} mm; the display's have {pitch:g} mm")
        sides = tuple(round(side) for side in sides)
        if any((count - side) % 2 for count, side in zip(shape, sides, strict=True)):
            raise ValueError(
                f"{sides[0]} × {sides[1]} pixels cannot be centred on {shape[0]} × {shape[1]}; "
                "give sides that are even or odd as the display's"
            )
    if any(side > count + 1e-3 for count, side in zip(shape, sides, strict=True)):
        raise ValueError(
            f"a mask of {sides[0]:g} × {sides[1]:g} pixels; the display has {shape[0]} × {shape[1]}"
        )
    shown, binary = mask, False
    if isinstance(mask, FresnelZoneAperture):
        binary = mask.profile == "binary"
        shown = FresnelZoneAperture(
            mask.beta,
            mask.phase,
            width=mask.width,
            height=mask.height,
            profile=mask.profile,
            centre=mask.centre,
            pixel_pitch=None if mask.pixels is None else pitch,
            harmonics=_HARMONICS,
        )
    amplitude = np.real(shown.sample(Grid(shape, pitch)))
    if binary:
        return np.where(amplitude > 0.5, 255, 0).astype(np.uint8)
    return np.rint(255 * np.clip(amplitude, 0.0, 1.0) ** 2).astype(np.uint8)


def on_cells(levels: np.ndarray, shape: tuple[int, int], side: int | None = None) -> np.ndarray:
    """Levels of cells (row, column), centred on the display.

    `side`: side of a cell in pixels; None: the largest that fits.

    **Errors**: ValueError where a cell would be smaller than a pixel.
    """
    most = min(shape[axis] // levels.shape[axis] for axis in (0, 1))
    size = side or most
    if most < size or size < 1:
        raise ValueError(
            f"{levels.shape[0]} × {levels.shape[1]} cells do not fit into {shape[0]} × {shape[1]} "
            "pixels; give fewer cells"
        )
    pattern = np.zeros(shape, np.uint8)
    top, left = ((shape[axis] - size * levels.shape[axis]) // 2 for axis in (0, 1))
    shown = np.kron(levels, np.ones((size, size), np.uint8))
    pattern[top : top + shown.shape[0], left : left + shown.shape[1]] = shown
    return pattern
