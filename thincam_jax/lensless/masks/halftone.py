"""Any grey mask in cells that are open or closed, as lithography makes it."""

from typing import Annotated, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number
from thincam_jax._core.grids import Grid
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax._core.quantity import choice
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.masks.phase import PhaseMask
from thincam_jax.lensless.masks.sampled import SampledMask

# By which a truncated series, as of the binary profile, may exceed the range of 0 to 1.
_OVERSHOOT = 0.1
Density = Literal["amplitude", "irradiance"]
DENSITIES: tuple[Density, ...] = get_args(Density)


@checked
def halftone(
    mask: AbstractMask, cell: Number, density: Annotated[Density, choice(DENSITIES)] = "amplitude"
) -> SampledMask:
    r"""The grey mask as a binary pattern of square cells, by error diffusion.

    A cell's error is passed on by the weights of Floyd and Steinberg (Proc. SID 17, 75, 1976), so
    that the open fraction of a small area is the grey level. The grey plate scatters nothing, the
    pattern scatters t − t² of the light, by angles up to about λ/(2·cell).

    - `cell`: side of a cell, mm, the finest part that the shop writes. Both sides of the mask must
      be whole numbers of cells.
    - `density`: transmittance that the open fraction is. "amplitude", t: the field that is not
      scattered is the grey plate's, and the PSF nears that of the plate as cells grow finer.
      "irradiance", |t|²: the light of each area is the plate's, which is closer where scattered
      light stays within its own zone: coarse cells, short distances.

    **Returns** a mask of zeros and ones: its PSF is that of the plate as made, scattered light
    included, for `tc.design.write_gds` to write and for reconstruction. `separable` samples
    pixels where a mask has more than 128 cells a side: `PsfMethod("separable", nodes=144)`.

    **Errors**: TypeError for a relief and where the mask or the cell are traced; ValueError, one
    line, for complex transmittances, for those outside of 0 to 1 and for sides that are no whole
    number of cells.

    ```python
    import thincam_jax as tc
    from thincam_jax.lensless.masks.halftone import halftone
    from thincam_jax.units import um

    plate = halftone(tc.FresnelZoneAperture(100.0, width=1.6), 4 * um)
    tc.design.write_gds("plate.gds", plate, smallest_feature=4 * um)
    tc.measured.write_image("plate.png", plate.amplitude[None])  # a pixel a cell
    ```

    **See also**: `tc.design.write_gds`, `lensless.masks.display.on_display`, `read_mask`.
    """
    import PIL.Image  # a camera waits for no library of images

    cell = checks.positive("cell", cell, "mm")
    if checks.holds_traced(mask, cell):
        raise TypeError("halftone needs a mask of known size and cells: call it outside of jit")
    if mask.pure_phase or isinstance(mask, PhaseMask):
        raise TypeError(f"a {type(mask).__name__} has no grey to halftone; give a grey mask")
    with jax.ensure_compile_time_eval():  # they are known under jit, too
        sides = tuple(zip(("height", "width"), mask.extent, strict=True))
    rows, columns = (checks.whole_cells(name, side, "cell", cell) for name, side in sides)
    refuse_if_too_large(
        f"a mask of {rows}×{columns} cells", 16 * rows * columns, "give larger cells"
    )
    # The cells are about the mask's centre, wherever it lies.
    middle = eqx.tree_at(lambda m: m.centre, mask, jnp.zeros_like(mask.centre))
    values = np.asarray(middle.sample(Grid((rows, columns), cell)))
    grey, phased = np.real(values), np.abs(np.imag(values)).max() > 1e-6
    if phased or grey.min() < -_OVERSHOOT or grey.max() > 1 + _OVERSHOOT:
        raise ValueError("the mask is no grey one; give amplitude transmittances from 0 to 1")
    grey = np.clip(grey, 0, 1)
    fraction = grey if density == "amplitude" else grey**2
    levels = np.round(255 * fraction).astype(np.uint8)
    opened = np.asarray(PIL.Image.fromarray(levels).convert("1"), grey.dtype)
    return SampledMask(opened, cell, centre=mask.centre)
