"""Patterns for a display, uint8 of its shape: masks, Hadamard frames, numbers to read back.

Levels are in proportion to the irradiance that the display lets through, as they are with its
table of grey levels.
"""

import numpy as np

from thincam_jax._core.grids import Grid
from thincam_jax.lensless.masks import FresnelZoneAperture
from thincam_jax.lensless.masks.cells import AbstractCellMask
from thincam_jax.measured.calibration.hadamard import HadamardSeries

_BITS = 16
_HARMONICS = 99  # what is left out of a profile's series is less than a level


def mask_pattern(
    mask: FresnelZoneAperture | AbstractCellMask, shape: tuple[int, int], pitch: float
) -> np.ndarray:
    """A Fresnel zone aperture or a mask of cells in the display's centre, black around it.

    The level is 255·t², with the mask's amplitude transmittance t at each pixel's centre; a mask of
    the profile "binary" has only 0 and 255. `pitch` is that of the display's pixels in mm. What
    their fill factor takes away, the display does itself.

    **Errors**: ValueError for zones of another pitch, cells of no whole number of pixels, a mask
    too large, or half a pixel off the pixels.
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


def hadamard_frame(
    series: HadamardSeries, number: int, shape: tuple[int, int], border: int = 0
) -> np.ndarray:
    """Frame `number` of a series in the display's centre, its cells as large as they fit.

    With a `border` of so many pixels, it carries its number (`with_number`).

    **Errors**: ValueError where a cell would be smaller than a pixel.
    """
    cells = series.frame(number)
    size = min((shape[axis] - 2 * border) // cells.shape[axis] for axis in (0, 1))
    if size < 1:
        raise ValueError(
            f"{cells.shape[0]} × {cells.shape[1]} cells do not fit into {shape[0]} × {shape[1]} "
            f"pixels with a border of {border}; give fewer cells"
        )
    pattern = np.zeros(shape, np.uint8)
    top, left = ((shape[axis] - size * cells.shape[axis]) // 2 for axis in (0, 1))
    shown = np.kron(255 * cells, np.ones((size, size), np.uint8))
    pattern[top : top + shown.shape[0], left : left + shown.shape[1]] = shown
    return with_number(pattern, number, border) if border else pattern


def with_number(pattern: np.ndarray, number: int, border: int) -> np.ndarray:
    """The pattern in a black border whose upper edge holds the number's 16 bits, white for 1.

    The lower edge holds their complement, so that a mixture of two patterns is told from either.
    """
    if not 0 <= number < 2**_BITS:
        raise ValueError(f"number = {number}: give 0 … {2**_BITS - 1}")
    if border < 1 or 2 * border > pattern.shape[0] or pattern.shape[1] < _BITS:
        raise ValueError(f"no border of {border} pixels fits on {pattern.shape} pixels")
    framed = np.zeros_like(pattern)
    inner = slice(border, -border), slice(border, -border)
    framed[inner] = pattern[inner]
    ends = np.linspace(0, pattern.shape[1], _BITS + 1).round().astype(int)
    for bit in range(_BITS):
        edge = slice(0, border) if number >> bit & 1 else slice(-border, None)
        framed[edge, ends[bit] : ends[bit + 1]] = 255
    return framed


def read_number(image: np.ndarray, border: int) -> int:
    """The number on an image of a display's border, cut to the display, of any size.

    `border` is in the image's pixels. ValueError where it holds no number, or two.
    """
    upper, lower = (part.mean(axis=0, dtype=float) for part in (image[:border], image[-border:]))
    width = image.shape[1] / _BITS
    half = max(width / 4, 0.5)  # the middle of a block, where no neighbour reaches
    differences = np.array(
        [
            np.mean((upper - lower)[round(middle - half) : round(middle + half)])
            for middle in width * (np.arange(_BITS) + 0.5)
        ]
    )
    largest = np.abs(differences).max()
    if not largest > 0 or np.any(np.abs(differences) < 0.7 * largest):
        raise ValueError("the border holds no number, or a mixture of two")
    return sum(1 << bit for bit, difference in enumerate(differences) if difference > 0)
