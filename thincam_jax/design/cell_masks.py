r"""Masks whose every cell is free, and their PSFs by two Fourier transforms.

The spectrum of cells of side a, with the amplitudes A, is periodic but for the factor of one cell,

.. math:: T(f) = a^2\,\mathrm{sinc}(a f_x)\,\mathrm{sinc}(a f_y) \sum_{ij} A_{ij}
    e^{-2\pi j a (i f_y + j f_x)}

and Fresnel diffraction over d, of light from a point at the distance t, multiplies it by
:math:`e^{-j\pi\lambda (d/M) f^2}`, M = 1 + d/t, on a sensor that is M times as large. The wave is
sampled three times a pixel and its power averaged over a pixel's cell. What the edges of cells send
beyond that band, 1/(π² a F) of the light for samples of rate 2F, is left out: spectra of random
cells are some 5 % off, expected errors up to 0.2 dB.
"""

import math
from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number
from thincam_jax._core.grids import Grid, fast_shape
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax._core.module import Module
from thincam_jax._core.precision import as_complex, decimal_value, phasor, squared_modulus
from thincam_jax._core.quantity import FieldError, choice, quantity, whole
from thincam_jax.lensless.masks.sampled import SampledMask

Levels = Literal["binary", "grey", "binary_phase", "phase"]
LEVELS: tuple[Levels, ...] = get_args(Levels)
Numbers = Float[Array, "capture free"]
Transmittances = Float[Array, "capture y x"] | Complex[Array, "capture y x"]

GREY = 2.0  # steepness of grey levels
# Margin beside the mask, as a part of what the band reaches; bytes of a sample that a slope holds.
_MARGIN, _BYTES = 2 / 3, 64
# Weights of a bin's three samples: the mean over them up to the fourth power of their distance.
_BIN = np.array([0.375, 0.25, 0.375])


@checked
class CellMasks(Module):
    """Masks of captures whose every cell, or ring of cells, is free.

    - `cell`: side of a cell, the least feature, mm.
    - `count`: cells along a side of the mask.
    - `distance`: d, mm; `wavelength`: mm.
    - `captures`: masks, which share the exposure evenly.
    - `levels`: "binary", open or closed; "grey", amplitudes of 0 to 1; "binary_phase", phases of
      0 and π; "phase", any phase.
    - `rings`: one number for all cells of a ring one cell wide, in place of one for each.
    - `fill_factor`: part of a cell's area that is open, of a display with dark gaps; None for all.
    - `contrast`: irradiance through open cells over that through closed ones; None where no light
      comes through these; for binary and grey levels.

    ```python
    from thincam_jax.design.cell_masks import CellMasks
    from thincam_jax.units import nm, um

    space = CellMasks(11 * um, 512, distance=6.5, wavelength=500 * nm)
    ```

    **See also**: `cell_search.find_cells`.
    """

    cell: Float[Array, ""] = eqx.field(converter=quantity("mm", check=checks.pixel_pitch))
    count: int = eqx.field(converter=whole(2, 4096), static=True)
    distance: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True), kw_only=True)
    wavelength: Float[Array, ""] = eqx.field(
        converter=quantity("mm", check=checks.wavelength), kw_only=True
    )
    captures: int = eqx.field(default=1, converter=whole(1, 8), static=True, kw_only=True)
    levels: Levels = eqx.field(
        default="binary", converter=choice(LEVELS), static=True, kw_only=True
    )
    rings: bool = eqx.field(default=False, static=True, kw_only=True)
    fill_factor: Float[Array, ""] | None = eqx.field(
        default=None, converter=quantity(check=checks.fraction, optional=True), kw_only=True
    )
    contrast: Float[Array, ""] | None = eqx.field(
        default=None, converter=quantity(least=1.0, most=1e9, optional=True), kw_only=True
    )

    def __check_init__(self):
        if self.contrast is not None and "phase" in self.levels:
            message = f"levels {self.levels!r} are all open: leave the contrast out"
            raise FieldError(message, "contrast")

    @property
    def width(self) -> Float[Array, ""]:
        """Side of a mask, mm."""
        return self.cell * self.count

    @property
    def free(self) -> int:
        """Free numbers of a capture."""
        return int(self._ring.max()) + 1 if self.rings else self.count**2

    @property
    def _ring(self) -> np.ndarray:
        """Ring of each cell."""
        places = np.arange(self.count) - (self.count - 1) / 2
        return np.hypot(places[:, None], places).astype(int)

    def parts(self, numbers: Numbers, steepness: Number | None = None) -> Numbers:
        """Levels of free numbers, 0 to 1: soft, a sigmoid, or by default as they are made."""
        if self.levels == "phase":
            return numbers
        if steepness is None and self.levels != "grey":
            return jnp.asarray(numbers > 0, numbers.dtype)
        slope = GREY if steepness is None or self.levels == "grey" else steepness
        return jax.nn.sigmoid(slope * numbers)

    def amplitudes(self, parts: Numbers) -> Transmittances:
        """Amplitude transmittance of every cell, of levels; phases are π times these."""
        if self.levels == "phase":
            parts = phasor(jnp.pi * parts)
        elif self.levels == "binary_phase":
            parts = 2 * parts - 1
        elif self.contrast is not None:
            parts = parts + (1 - parts) / jnp.sqrt(self.contrast)
        return parts[:, self._ring] if self.rings else parts.reshape(-1, *(self.count,) * 2)

    def masks(self, numbers: Numbers) -> list[SampledMask]:
        """The mask of each capture, as it is made."""
        found = self.amplitudes(self.parts(jnp.asarray(numbers)))
        return [SampledMask(one, self.cell, fill_factor=self.fill_factor) for one in found]


class CellOptics(eqx.Module):
    """PSFs of cells on a grid of about the sensor's pixels, see the module.

    - `grid`: samples of the PSFs.
    - `wave`: factor of the spectrum along an axis; `samples`: number of them in a cell.
    - `split`: parts along a side of each cell, in which amplitudes are given.
    - `between`: places on the grid's axis where PSFs are taken, if their own magnification is not
      the grid's.
    """

    grid: Grid
    wave: Complex[Array, " f"]
    between: Float[Array, " x"] | None
    cells: int = eqx.field(static=True)
    samples: int = eqx.field(static=True)
    split: int = eqx.field(static=True)

    def __init__(
        self,
        masks: CellMasks,
        object_distance: float,
        pitch: float,
        *,
        cells: int | None = None,
        split: int = 1,
        focus: float | None = None,
    ):
        """`cells`: along a side of the window; by default those that the light can reach.

        `focus`: object distance whose grid PSFs are interpolated on; by default their own.
        """
        cell, distance, wavelength = (
            float(decimal_value(length))
            for length in (masks.cell, masks.distance, masks.wavelength)
        )
        magnification, self.split = 1 + distance / object_distance, split
        shown = magnification if focus is None else 1 + distance / focus
        self.samples = 3 * max(1, round(cell * shown / pitch))
        reach = wavelength * distance / cell**2 * self.samples / 2  # of the band, cells
        self.cells = cells or fast_shape((math.ceil(masks.count + 2 * _MARGIN * reach), 1))[0]
        total = self.cells * self.samples
        refuse_if_too_large("cells of a mask", _BYTES * total**2, "give fewer or larger cells")
        step, part = cell / self.samples, cell / split
        f = np.fft.fftfreq(total, step)
        path = wavelength * distance / magnification
        # The middle of the samples is that of the mask.
        ahead = (masks.count * split - 1) / 2 * part - (total - 1) / 2 * step
        side = 1.0 if masks.fill_factor is None else float(masks.fill_factor) ** 0.5
        shape = side * part / step * np.sinc(side * part * f)
        self.wave = jnp.asarray(shape * np.exp(-1j * np.pi * f * (path * f - 2 * ahead)))
        self.grid = Grid((total // 3,) * 2, 3 * step * shown)
        middle, self.between = (total // 3 - 1) / 2, None
        if shown != magnification:
            places = (np.arange(total // 3) - middle) * (shown / magnification) + middle
            self.between = jnp.asarray(places, float)

    def __call__(self, amplitude: Float[Array, "y x"] | Complex[Array, "y x"]):
        """Irradiance over that of the open mask, averaged over the grid's cells."""
        power = self.power(self.spectrum(amplitude))
        if self.between is None:
            return power
        return _interpolated(_interpolated(power, self.between).T, self.between).T

    def spectrum(self, amplitude: Float[Array, "y x"] | Complex[Array, "y x"]):
        """Spectrum of the wave on the sensor, of cells in `split` parts along a side."""
        if not jnp.iscomplexobj(amplitude):
            amplitude = as_complex(amplitude)
        spectrum = jnp.fft.fft2(amplitude, (self.cells * self.split,) * 2)
        if self.split == 1:
            spectrum = jnp.tile(spectrum, (self.samples,) * 2)
        else:
            total = self.cells * self.samples
            places = np.fft.fftfreq(total, 1 / total).astype(int) % len(spectrum)
            spectrum = spectrum[places][:, places]
        return spectrum * self.wave[:, None] * self.wave

    def power(self, spectrum: Complex[Array, "v u"]) -> Float[Array, "y x"]:
        """Irradiance of a wave of this spectrum, averaged over the grid's cells."""
        power = squared_modulus(jnp.fft.ifft2(spectrum))
        (bins, _), weights = self.grid.shape, jnp.asarray(_BIN, power.dtype)
        parts = power.reshape(bins, 3, bins, 3)
        return jnp.einsum("yaxb,a,b->yx", parts, weights, weights, precision="highest")


def _interpolated(rows: Float[Array, "y x"], places: Float[Array, " z"]) -> Float[Array, "z x"]:
    """Rows at places between them, by the cubics of Catmull and Rom; dark beyond."""
    x = (places - jnp.floor(places))[:, None].astype(rows.dtype)
    first = jnp.floor(places).astype(int)
    weights = (
        ((2 - x) * x - 1) * x / 2,
        ((3 * x - 5) * x**2 + 2) / 2,
        ((4 - 3 * x) * x + 1) * x / 2,
        (x - 1) * x**2 / 2,
    )
    near = [jnp.take(rows, first + n, axis=0, mode="fill", fill_value=0) for n in range(-1, 3)]
    return sum((w * r for w, r in zip(weights[1:], near[1:], strict=True)), weights[0] * near[0])


def drawn_cells(masks: CellMasks, rng: np.random.Generator) -> Bool[np.ndarray, "capture cell"]:
    """Random masks: squares of cells, of any side, number and open part, in the middle."""
    if masks.rings:
        width = int(rng.integers(1, max(2, masks.free // 4)))
        opened = rng.random((masks.captures, masks.free // width + 1)) < rng.uniform(0.05, 1)
        return np.repeat(opened, width, 1)[:, : masks.free]

    def one():
        side = int(rng.integers(1, min(17, masks.count + 1)))
        most = masks.count // side
        across = int(np.exp(rng.uniform(0, np.log(most + 1))))
        opened = rng.random((across, across)) < np.exp(rng.uniform(np.log(0.01), 0))
        cells = np.kron(opened, np.ones((side, side), bool))
        before = (masks.count - len(cells)) // 2
        return np.pad(cells, (before, masks.count - len(cells) - before)).ravel()

    return np.stack([one() for _ in range(masks.captures)])


def without_lone_cells(cells: Array) -> Array:
    """Cells (…, y, x) of 0 and 1 of which each has one of its kind beside it.

    Open ones without are closed, then closed ones opened; beyond the mask it is closed.
    """
    for lone in (1, 0):
        around = jnp.pad(cells, [(0, 0)] * (cells.ndim - 2) + [(1, 1)] * 2)
        beside = (around[..., 2:, 1:-1], around[..., :-2, 1:-1])
        beside += (around[..., 1:-1, 2:], around[..., 1:-1, :-2])
        alone = (cells == lone) & jnp.all(jnp.stack(beside) != lone, axis=0)
        cells = jnp.where(alone, 1 - cells, cells)
    return cells
