"""A mask given by numbers: any pattern, measured or designed."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.grids import Grid, cell_overlap, centred_indices
from thincam_jax._core.precision import product
from thincam_jax.lensless.masks.base import AbstractMask


class SampledMask(AbstractMask):
    """A mask of square cells, each with one complex amplitude transmittance.

    **Arguments**

    - `amplitude`: amplitude transmittance of each cell, (y, x); at most 1 for a passive mask.
    - `pitch`: side of a cell, mm.
    - `centre`: (y, x) of the mask's centre, mm.
    """

    amplitude: Complex[Array, "y x"] | Float[Array, "y x"]
    pitch: Float[Array, ""]
    centre: Float[Array, "2"]

    def __init__(
        self,
        amplitude: Any,
        pitch: Number,
        *,
        centre: Numbers | tuple[Number, Number] = (0.0, 0.0),
    ):
        self.amplitude = jnp.asarray(amplitude)
        if self.amplitude.ndim != 2 or 0 in self.amplitude.shape:
            raise ValueError(
                f"amplitude has shape {self.amplitude.shape}; give a non-empty array (y, x)"
            )
        if not checks.is_traced(self.amplitude) and not np.isfinite(self.amplitude).all():
            raise ValueError("amplitude holds NaN or infinity; give finite transmittances")
        if not jnp.issubdtype(self.amplitude.dtype, jnp.inexact):
            self.amplitude = self.amplitude.astype(float)
        self.pitch = checks.positive("pitch", pitch, "mm")
        self.centre = checks.finite("centre", centre, "mm", shape=(2,))

    @property
    def extent(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        rows, columns = self.amplitude.shape
        return rows * self.pitch, columns * self.pitch

    @property
    def finest_frequency(self) -> float:
        """Beyond which, along either axis, half of the modulation |t|² − mean lies, cycles/mm."""
        shadow = np.abs(np.asarray(self.amplitude)) ** 2
        power = np.abs(np.fft.rfft2(shadow - shadow.mean())) ** 2
        power[:, 1 : (shadow.shape[1] + 1) // 2] *= 2  # the columns that are left out
        down, across = np.fft.fftfreq(shadow.shape[0]), np.fft.rfftfreq(shadow.shape[1])
        frequency = np.maximum(abs(down[:, None]), across).ravel()
        order = np.argsort(frequency)
        below = np.cumsum(power.ravel()[order])
        place = np.searchsorted(below, below[-1] / 2)
        return float(frequency[order[place]] / np.asarray(self.pitch))

    def sample(
        self, grid: Grid, wavelength: Number | None = None
    ) -> Complex[Array, "y x"] | Float[Array, "y x"]:
        rows, columns = self.amplitude.shape
        dtype = self.amplitude.dtype
        down = _coverage(grid.y - self.centre[0], grid.pitch, rows, self.pitch).astype(dtype)
        across = _coverage(grid.x - self.centre[1], grid.pitch, columns, self.pitch).astype(dtype)
        return product(product(down, self.amplitude), across.T)


def _coverage(x, pitch, cells: int, cell_pitch) -> Float[Array, "n cell"]:
    """Part of each sample's cell that each mask cell covers."""
    centres = centred_indices(cells, x.dtype) * cell_pitch
    return cell_overlap(x, pitch, centres - cell_pitch / 2, centres + cell_pitch / 2) / pitch
