"""A mask given by numbers: any pattern, measured or designed."""

import os
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number
from thincam_jax._core.grids import Grid, cell_overlap, centred_indices
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax._core.precision import as_complex, product
from thincam_jax._core.quantity import quantity
from thincam_jax._core.random import Key, random_key
from thincam_jax.lensless.masks.base import (
    AbstractFactoredMask,
    AxisFactors,
    MaskTerms,
    Transmittance,
    open_parts,
)
from thincam_jax.lensless.masks.cells import cell_edges

_WIDEST = 1000.0  # mm, of a mask from an image


def _amplitudes(given: Any) -> Transmittance:
    amplitude = checks.array("amplitude", given, allow_complex=True)
    if amplitude.ndim != 2 or 0 in amplitude.shape:
        raise ValueError(f"amplitude has shape {amplitude.shape}; give a non-empty array (y, x)")
    if not checks.is_traced(amplitude):
        largest = np.abs(amplitude).max()
        if not np.isfinite(largest):
            raise ValueError("amplitude holds NaN or infinity; give finite transmittances")
        checks.scaled("amplitude", largest)
    return amplitude if jnp.issubdtype(amplitude.dtype, jnp.inexact) else amplitude.astype(float)


class SampledMask(AbstractFactoredMask):
    """A mask of square cells, each with one complex amplitude transmittance.

    It has a term for each row (or column, where these are fewer): with few, `separable` is exact
    and fast, and its work grows as their square.

    **Arguments**

    - `amplitude`: amplitude transmittance of each cell, (y, x); at most 1 for a passive mask.
    - `pitch`: side of a cell, mm.
    - `centre`: (y, x) of the mask's centre, mm.
    - `fill_factor`: part of a cell's area that is open, in its middle; None for all of it.
    - `gap`: amplitude transmittance between the open parts; None where it is dark.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.SampledMask([[1.0, 0.0, 1.0], [0.0, 1.0, 0.5]], pitch=100 * um)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    h = tc.psf(camera, wavelength=500 * nm)
    ```

    **See also**: `lensless.masks.random_cells`, `read_mask`.
    """

    amplitude: Transmittance = eqx.field(converter=_amplitudes)
    pitch: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    centre: Float[Array, "2"] = eqx.field(
        default=(0, 0), converter=quantity("mm", shape=(2,)), kw_only=True
    )
    fill_factor: Float[Array, ""] | None = eqx.field(
        default=None, converter=quantity(check=checks.fraction, optional=True), kw_only=True
    )
    gap: Float[Array, ""] | None = eqx.field(
        default=None, converter=quantity(least=0.0, most=1.0, optional=True), kw_only=True
    )

    def __check_init__(self):
        if self.gap is not None and self.fill_factor is None:
            raise ValueError("cells that are open all over have no gap: give a fill_factor, too")

    @property
    def extent(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        rows, columns = self.amplitude.shape
        return rows * self.pitch, columns * self.pitch

    @property
    def finest_frequency(self) -> float | None:
        """Beyond which half of |t|² − mean lies, along either axis, cycles/mm; None of phases."""
        shadow = np.abs(np.asarray(self.amplitude)) ** 2
        if jnp.iscomplexobj(self.amplitude) and np.ptp(shadow) < 1e-5 * shadow.max():
            return None
        power = np.abs(np.fft.rfft2(shadow - shadow.mean())) ** 2
        power[:, 1 : (shadow.shape[1] + 1) // 2] *= 2  # the columns that are left out
        down, across = np.fft.fftfreq(shadow.shape[0]), np.fft.rfftfreq(shadow.shape[1])
        frequency = np.maximum(abs(down[:, None]), across).ravel()
        order = np.argsort(frequency)
        below = np.cumsum(power.ravel()[order])
        place = np.searchsorted(below, below[-1] / 2)
        return float(frequency[order[place]] / np.asarray(self.pitch))

    def without_dark_margins(self) -> "SampledMask":
        """The mask halved about its centre for as long as what falls away is dark.

        A small lens of cells amid dark ones has a tenth of the terms, and fewer fringes a pixel.
        Halves leave few shapes to compile for.
        """
        if self.gap is not None or checks.is_traced(self.amplitude):
            return self
        amplitude = np.asarray(self.amplitude)
        kept = tuple(_lit_middle(np.any(amplitude, axis=axis)) for axis in (1, 0))
        if amplitude[kept].shape == amplitude.shape:
            return self
        return eqx.tree_at(lambda mask: mask.amplitude, self, jnp.asarray(amplitude[kept]))

    def terms(self, wavelength: Number | None = None) -> MaskTerms:
        return self._terms(self.amplitude, self.gap)

    def irradiance(self, wavelength: Number | None = None) -> MaskTerms:
        return self._terms(jnp.abs(self.amplitude) ** 2, None if self.gap is None else self.gap**2)

    def _terms(self, values, gap) -> MaskTerms:
        """A term for each row of the values, or for each column; one of the whole, with a gap."""
        values = values if jnp.iscomplexobj(values) else as_complex(values)
        if gap is not None:
            gap = as_complex(gap)
            values = jax.scipy.linalg.block_diag(values - gap, gap)
        rows, columns = values.shape
        each = jnp.eye(min(rows, columns), dtype=values.dtype)
        down, across = (each, values) if rows <= columns else (values.T, each)
        return MaskTerms(jnp.ones_like(each[0]), self._factors(down), self._factors(across))

    def _factors(self, values: Complex[Array, "term cell"]) -> AxisFactors:
        if self.fill_factor is None:
            return AxisFactors(cell_edges(values.shape[1], self.pitch), values)
        gaps = None
        if self.gap is not None:
            values, gaps = values[:, :-1] + values[:, -1:], values[:, -1:]
        return open_parts(values, self.pitch, self.fill_factor, gaps)

    def sample(self, grid: Grid, wavelength: Number | None = None) -> Transmittance:
        rows, columns = self.amplitude.shape
        dtype = self.amplitude.dtype
        down = self._coverage(grid.y - self.centre[0], grid.pitch, rows).astype(dtype)
        across = self._coverage(grid.x - self.centre[1], grid.pitch, columns).astype(dtype)
        if self.gap is not None:
            return super().sample(grid, wavelength)
        return product(product(down, self.amplitude), across.T)

    def _coverage(self, x, pitch, cells: int) -> Float[Array, "n cell"]:
        """Part of each sample's cell that the open part of each mask cell covers."""
        centres = centred_indices(cells, x.dtype) * self.pitch
        half = self.pitch / 2
        if self.fill_factor is not None:
            half = half * jnp.sqrt(self.fill_factor)
        return cell_overlap(x, pitch, centres - half, centres + half) / pitch


def _lit_middle(lit: Bool[np.ndarray, " n"]) -> slice:
    """Part in the middle that is left of halving while it holds all that is lit."""
    margin, count = 0, lit.size
    while lit.any() and (step := (count - 2 * margin) // 4):
        if lit[: margin + step].any() or lit[count - margin - step :].any():
            break
        margin += step
    return slice(margin, count - margin)


def random_cells(
    key: Key,
    width: Number,
    cell: Number,
    *,
    height: Number | None = None,
    open_fraction: Number = 0.5,
) -> SampledMask:
    """A mask of cells that are open or closed at random; of no low rank.

    `width`, `height` (mm; None for a square) are whole numbers of cells; `open_fraction` is the
    chance of a cell to be open. `key`: key of `jax.random`, or a seed.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import um

    mask = tc.lensless.masks.random_cells(0, width=0.6, cell=30 * um)
    print(mask.amplitude.shape)  # (20, 20)
    ```

    **See also**: `SampledMask`.
    """
    columns = checks.whole_cells("width", width, "cell", cell)
    rows = columns if height is None else checks.whole_cells("height", height, "cell", cell)
    chance = checks.fraction("open_fraction", open_fraction)
    refuse_if_too_large(
        f"a mask of {rows}×{columns} cells", 16 * rows * columns, "give larger cells"
    )
    opened = jax.random.bernoulli(random_key(key), chance, (rows, columns))
    return SampledMask(opened.astype(float), cell)


def read_mask(path: str | os.PathLike[str], cell: Number) -> SampledMask:
    """A mask from a grey image: one cell a pixel, white open, a level in proportion to |t|².

    **Errors**: FileNotFoundError; ValueError, one line, for a file that is no image, for one with
    colours, for one that lets no light pass, and for a mask over a metre wide, as where `cell` is
    the mask's width.

    ```python
    import numpy as np
    import PIL.Image
    import thincam_jax as tc

    PIL.Image.fromarray(np.eye(20, dtype=np.uint8) * 255).save("mask.png")
    mask = tc.read_mask("mask.png", 0.03)  # cells of 30 µm
    ```

    **See also**: `SampledMask`, `load_image`.
    """
    # Here: a camera waits for no library that reads files.
    from thincam_jax.imaging.targets.images import load_image

    levels = load_image(path, linear=True)
    if levels.ndim == 3 and np.ptp(levels, axis=-1).max() > 0:
        raise ValueError(f"{str(path)!r} is coloured; give a grey image, white where it is open")
    levels = levels if levels.ndim == 2 else levels[..., 0]
    if not levels.any():
        raise ValueError(f"{str(path)!r} is black: no light passes; paint what is open white")
    mask = SampledMask(np.sqrt(levels), cell)
    if not checks.is_traced(mask.pitch) and levels.shape[1] * float(mask.pitch) > _WIDEST:
        pitch, count = float(mask.pitch), levels.shape[1]
        raise ValueError(
            f"cell = {pitch:g} mm makes a mask {count * pitch:.0f} mm wide; give the side of one "
            f"pixel of the image: {pitch / count:.3g} for a mask {pitch:g} mm wide"
        )
    return mask
