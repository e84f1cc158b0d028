"""Files of masks of cells: pictures that are read back, and what a shop makes them from."""

import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from thincam_jax._core.arguments import checked
from thincam_jax._core.files import write_whole
from thincam_jax.design.cell_search import CellDesign
from thincam_jax.design.grey_files import write_density_map
from thincam_jax.design.layout import write_gds
from thincam_jax.design.phase_mask import mask_of_phase, one_turn
from thincam_jax.design.relief_files import write_height_map
from thincam_jax.imaging.encoding import png_bytes
from thincam_jax.lensless.masks.phase import MaskBlank
from thincam_jax.lensless.masks.sampled import SampledMask


@checked
def write_cells(
    folder: str | os.PathLike[str], design: CellDesign, *, index: float = 1.52
) -> dict[str, str]:
    """Write each capture's mask: mask.png, of several mask-1.png and so on, and files for a shop.

    - "binary": white is open; NAME.gds as by `write_gds`, where gdstk is installed.
    - "grey": 16 bits of |t|², with their scale in NAME.json, as by `write_density_map`.
    - "phase", "binary_phase": white is a turn; NAME-height.png and .json as by `write_height_map`,
      of a material of the refractive `index`.

    Cells are as wide as they are apart, closed ones dark. `read_mask` reads a PNG of amplitudes.

    **Returns** what each file is, by its name.
    """
    space, folder, written = design.space, Path(folder), {}
    masks = space.replace(fill_factor=None, contrast=None).masks(jnp.asarray(design.numbers))
    for number, mask in enumerate(masks, 1):
        name = "mask" if len(masks) == 1 else f"mask-{number}"
        if "phase" in space.levels:
            written |= _write_phases(folder, name, mask, space.wavelength, index)
        elif space.levels == "grey":
            write_density_map(folder / f"{name}.png", mask, space.cell)
            written[f"{name}.png"] = "transmittance |t|² in 16 bits, a pixel a cell"
            written[f"{name}.json"] = "its scale, and a table of densities"
        else:
            counts = (255 * np.asarray(mask.amplitude)).astype(np.uint8)
            write_whole(folder / f"{name}.png", png_bytes(counts))
            written[f"{name}.png"] = "white is open, a pixel a cell"
            try:
                write_gds(folder / f"{name}.gds", mask)
                written[f"{name}.gds"] = "layout of the open cells, in µm"
            except ImportError as error:
                written[f"{name}.gds"] = f"not written, {error}"
    return written


def _write_phases(
    folder: Path, name: str, mask: SampledMask, wavelength, index: float
) -> dict[str, str]:
    turns = np.angle(np.asarray(mask.amplitude)) / (2 * np.pi) % 1
    write_whole(folder / f"{name}.png", png_bytes(np.round(255 * turns).astype(np.uint8)))
    blank = MaskBlank(turns.shape, mask.pitch, index)
    phase = jnp.asarray(2 * np.pi * turns, float)
    relief = mask_of_phase(phase, blank, wavelength, one_turn(blank, wavelength))
    write_height_map(folder / f"{name}-height.png", relief, wavelength=wavelength)
    return {
        f"{name}.png": "phase, white is a turn, a pixel a cell",
        f"{name}-height.png": f"heights of a relief of index {index:g}",
        f"{name}-height.json": "their scale, mm",
    }
