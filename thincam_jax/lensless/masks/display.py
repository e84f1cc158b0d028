"""Any mask as a display shows it: in pixels of one value each, with dark gaps between them."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number
from thincam_jax._core.grids import Grid, centred_indices
from thincam_jax._core.quantity import unchecked
from thincam_jax.lensless.masks.base import (
    AbstractFactoredMask,
    AbstractMask,
    AxisFactors,
    MaskTerms,
    open_parts,
    term_count,
)
from thincam_jax.lensless.masks.phase import PhaseMask
from thincam_jax.lensless.masks.sampled import SampledMask


class DisplayedMask(AbstractFactoredMask):
    """A mask of few terms in the pixels of a display; made by `on_display`."""

    mask: AbstractFactoredMask
    centre: Float[Array, "2"] = eqx.field(converter=unchecked("mm"))
    pixel_pitch: Float[Array, ""] = eqx.field(converter=unchecked("mm"))
    fill_factor: Float[Array, ""]
    pixels: tuple[int, int] = eqx.field(static=True)

    @property
    def extent(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        rows, columns = self.pixels
        return rows * self.pixel_pitch, columns * self.pixel_pitch

    @property
    def finest_frequency(self) -> Float[Array, ""]:
        """Frequency of alternating pixels, cycles/mm."""
        return 0.5 / self.pixel_pitch

    def terms(self, wavelength: Number | None = None) -> MaskTerms:
        terms = self.mask.terms(wavelength)
        columns = self._shown(terms.columns, self.pixels[1])
        same = terms.rows is terms.columns and self.pixels[0] == self.pixels[1]
        rows = columns if same else self._shown(terms.rows, self.pixels[0])
        return MaskTerms(terms.coefficients, rows, columns)

    def _shown(self, factors: AxisFactors, count: int) -> AxisFactors:
        centres = centred_indices(count, self.pixel_pitch.dtype) * self.pixel_pitch
        values = factors.samples(centres, self.pixel_pitch)
        return open_parts(values, self.pixel_pitch, self.fill_factor)


@checked
def on_display(mask: AbstractMask, pixel_pitch: Number, fill_factor: Number = 1.0) -> AbstractMask:
    """The mask as a display (a spatial light modulator) shows it.

    Each pixel has one value: the pattern's at its centre where that is smooth, as of zones and of
    a relief's height, and the mean over the pixel where it has cells or edges. Only the middle of a
    pixel is open, √fill_factor of its side; the gaps between are dark.

    - `pixel_pitch`: mm. Both sides of the mask must be whole numbers of pixels.
    - `fill_factor`: open fraction of a pixel's area, 0 < fill_factor ≤ 1.

    **Returns** a mask of as many terms, for which `separable` is exact, or, of a mask without few
    terms, a `SampledMask` or `PhaseMask` of the display's pixels.

    **Errors**: ValueError, one line, for sides that are no whole number of pixels; TypeError where
    the mask or the pitch are traced. Gradients for them go through the `DisplayedMask` itself.

    ```python
    import thincam_jax as tc
    from thincam_jax.lensless.masks.display import on_display
    from thincam_jax.units import um

    mask = on_display(tc.FresnelZoneAperture(25.0, width=1.44), 36 * um, fill_factor=0.9)
    ```

    **See also**: `FresnelZoneAperture`.
    """
    pitch = checks.positive("pixel_pitch", pixel_pitch, "mm")
    fill = checks.fraction("fill_factor", fill_factor)
    if checks.holds_traced(mask, pitch):
        raise TypeError("on_display needs a mask of known size and pitch: call it outside of jit")
    with jax.ensure_compile_time_eval():  # they are known under jit, too
        sides = tuple(zip(("height", "width"), mask.extent, strict=True))
    rows, columns = (checks.whole_cells(n, side, "pixel_pitch", pitch) for n, side in sides)
    grid = Grid((rows, columns), pitch)
    # The pixels are about the mask's centre, wherever it lies.
    middle = eqx.tree_at(lambda m: m.centre, mask, jnp.zeros_like(mask.centre))
    if isinstance(middle, PhaseMask):
        amplitude = middle.amplitude
        if amplitude is not None:
            amplitude = jnp.real(SampledMask(amplitude, middle.pitch).sample(grid))
        shown = {"amplitude": amplitude, "centre": mask.centre, "fill_factor": fill}
        return PhaseMask(middle.heights(grid), pitch, middle.material, **shown)
    if isinstance(middle, AbstractFactoredMask) and term_count(middle).terms < min(rows, columns):
        return DisplayedMask(
            mask=middle, centre=mask.centre, pixel_pitch=pitch, fill_factor=fill, pixels=grid.shape
        )
    return SampledMask(middle.sample(grid), pitch, centre=mask.centre, fill_factor=fill)
