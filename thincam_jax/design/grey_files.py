"""Grey masks as tables for grey-scale writers: 16-bit pictures with their scale."""

import os
from pathlib import Path

import numpy as np

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number
from thincam_jax._core.files import write_whole
from thincam_jax._core.grids import Grid
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax.imaging.encoding import png_bytes
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.masks.phase import PhaseMask
from thincam_jax.measured.write import linear_bytes, log_text

_FULL = 2**16 - 1
_OPAQUE = 5.0  # optical density of a count of 0


@checked
def write_density_map(path: str | os.PathLike[str], mask: AbstractMask, pixel: Number) -> Path:
    r"""Write a grey mask as a 16-bit picture of its transmittance, and its scale as NAME.json.

    A count c is the share c/65535 of the light that a pixel's middle passes, T = |t|²: give pixels
    finer than the zones. The optical density is
    :math:`D = -\log_{10} T`, at most 5. The JSON has the `pixel_mm`, the `shape`, the
    `centre_mm` and a table of densities at 17 counts, for the writer's own calibration curve. Rows
    run downwards. `write_height_map` is that of a relief.

    - `path`: .png or .tif. `pixel`: side of a pixel, mm; the mask's sides are whole numbers of it.

    **Errors**: TypeError for a phase mask; ValueError for another suffix, complex transmittances,
    those over 1, and sides that are no whole number of pixels.

    ```python
    import thincam_jax as tc
    from thincam_jax.design.grey_files import write_density_map
    from thincam_jax.units import um

    write_density_map("plate.png", tc.FresnelZoneAperture(100.0, width=1.6), 8 * um)
    ```

    **See also**: `design.write_gds`, `lensless.masks.halftone.halftone`, `write_height_map`.
    """
    path, pixel = Path(path), float(checks.positive("pixel", pixel, "mm"))
    if path.suffix.lower() not in (".png", ".tif", ".tiff"):
        raise ValueError(f"{path}: density maps are written as .png or .tif; give this suffix")
    if mask.pure_phase or isinstance(mask, PhaseMask):
        raise TypeError(f"a {type(mask).__name__} has no density; write it by write_height_map")
    sides = tuple(zip(("height", "width"), mask.extent, strict=True))
    rows, columns = (checks.whole_cells(name, side, "pixel", pixel) for name, side in sides)
    refuse_if_too_large(f"a table of {rows}×{columns}", 16 * rows * columns, "give larger pixels")
    middle = mask.replace(centre=np.zeros(2, np.asarray(mask.centre).dtype))
    values = np.asarray(middle.sample(Grid((rows, columns), pixel)))
    if np.abs(np.imag(values)).max() > 1e-6 or np.abs(values).max() > 1.1:
        raise ValueError("the mask is no grey one; give amplitude transmittances from 0 to 1")
    counts = np.rint(_FULL * np.clip(np.real(values) ** 2, 0, 1)).astype(np.uint16)
    steps = np.linspace(0, _FULL, 17).round()
    light = np.maximum(steps / _FULL, 10**-_OPAQUE)
    record = {
        "format": "thincam_jax density map 1",
        "transmittance_per_count": 1 / _FULL,
        "pixel_mm": pixel,
        "shape": [rows, columns],
        "centre_mm": [float(c) for c in np.asarray(mask.centre)],
        "counts": steps.tolist(),
        "densities": np.round(-np.log10(light), 4).tolist(),
    }
    write_whole(path.with_suffix(".json"), log_text(record))
    is_png = path.suffix.lower() == ".png"
    return write_whole(path, png_bytes(counts) if is_png else linear_bytes(counts[None], ".tif"))
