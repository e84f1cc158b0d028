r"""Phase masks: a relief of a transparent material that delays the light."""

import functools
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number
from thincam_jax._core.grids import Grid, cell_overlap
from thincam_jax._core.module import Module
from thincam_jax._core.precision import as_complex, turn_phasor
from thincam_jax._core.quantity import choice, quantity
from thincam_jax.imaging.refractive_index import AbstractIndex, as_index
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.masks.sampled import SampledMask

Interpolation = Literal["cells", "bilinear"]
# mm: above it a relief is no thin mask, and what is given in micrometres is above it too.
HIGHEST = 0.1


def _map(name: str, values: Any, lowest: float, highest: float, unit: str) -> Float[Array, "y x"]:
    """A real (y, x) map within its limits, or one line that says what is out of them."""
    array = checks.as_array(checks.array(name, values), floating=True)
    if array.ndim != 2 or 0 in array.shape:
        raise ValueError(f"{name} has shape {array.shape}; give a non-empty array (y, x)")
    if checks.is_traced(array):
        return array
    known = np.asarray(array)
    if not np.isfinite(known).all():
        raise ValueError(f"{name} holds NaN or infinity; give finite numbers in {unit}")
    # In single precision a number may lie a rounding beyond its own limit.
    slack = 1e-6 * (highest - lowest)
    if known.min() < lowest - slack or known.max() > highest + slack:
        raise ValueError(
            f"{name} reaches from {known.min():.4g} to {known.max():.4g}; give {lowest:g} to "
            f"{highest:g} {unit}"
        )
    return array


_HEIGHT = functools.partial(_map, lowest=0.0, highest=HIGHEST, unit="mm, such as 1.2 * um")
_AMPLITUDE = functools.partial(_map, lowest=0.0, highest=1.0, unit="parts of one")


class PhaseMask(AbstractMask):
    r"""A thin relief of heights h: it delays the light by (n − 1)h against air.

    .. math:: t(x, y) = A(x, y)\, e^{2\pi j\,[n(\lambda) - 1]\, h(x, y)/\lambda}

    Beyond the height map the mask is opaque. The element is thin: light passes it straight on,
    which is right while the relief is much lower than its features are wide.

    **Arguments**

    - `height`: h at the cells' centres, (y, x), mm, from 0 to 0.1.
    - `pitch`: distance of the centres, mm.
    - `material`: refractive index, a number or one of `thincam_jax.imaging.refractive_index`.
    - `amplitude`: A of each cell, (y, x), from 0 to 1; None is 1 everywhere.
    - `centre`: (y, x) of the mask's centre, mm.
    - `interpolation`: "cells", each of one height, with steps between them (what is written in
      pixels); "bilinear" between the centres, constant beyond the outermost (smooth reliefs).
      Samples hold the mean transmittance of their area of cells, the value at their centre of
      bilinear ones, both times the open part at the rim. A is that of cells in both.
    - `fill_factor`: part of a cell's area that is open, in its middle, of a display with dark gaps;
      None for all of it. Of "cells" only.

    **Sampling.** `angular_spectrum` and `rayleigh_sommerfeld` hold a mask where its phase turns by
    less than π between samples, cells where samples are no larger than they; `psf` refuses
    the others (`thincam_jax.lensless.sampling.require_phase_sampling`).

    **Errors**: ValueError or TypeError, one line, for what is out of range.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import um

    import numpy as np

    steps = np.tile([0.0, 0.5e-3], (24, 16))  # heights, mm
    mask = tc.PhaseMask(steps, pitch=10 * um, material=1.5)
    ```

    **See also**: `lensless.masks.MaskBlank`, `lensless.masks.reliefs.diffuser`.
    """

    height: Float[Array, "y x"] = eqx.field(converter=quantity("mm", check=_HEIGHT))
    pitch: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    material: AbstractIndex = eqx.field(converter=quantity(check=as_index))
    amplitude: Float[Array, "y x"] | None = eqx.field(
        default=None, converter=quantity(check=_AMPLITUDE, optional=True), kw_only=True
    )
    centre: Float[Array, "2"] = eqx.field(
        default=(0, 0), converter=quantity("mm", shape=(2,)), kw_only=True
    )
    fill_factor: Float[Array, ""] | None = eqx.field(
        default=None, converter=quantity(check=checks.fraction, optional=True), kw_only=True
    )
    interpolation: Interpolation = eqx.field(
        default="cells", converter=choice(get_args(Interpolation)), static=True, kw_only=True
    )

    def __check_init__(self):
        if self.amplitude is not None and self.amplitude.shape != self.height.shape:
            raise ValueError(
                f"amplitude has shape {self.amplitude.shape} and height {self.height.shape}; "
                "give one amplitude for each height"
            )
        if self.fill_factor is not None and self.interpolation != "cells":
            raise ValueError("heights in between have no gaps: leave fill_factor out")

    @property
    def extent(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        rows, columns = self.height.shape
        return rows * self.pitch, columns * self.pitch

    @property
    def pure_phase(self) -> bool:
        return self.amplitude is None

    def turns(self, wavelength: Number) -> Float[Array, "y x"]:
        """[n(λ) − 1]h/λ: the phase of each cell in turns."""
        light = jnp.asarray(wavelength, self.height.dtype)
        return self.height * ((self.material(light) - 1) / light)

    def steepest_frequency(self, wavelength: Number) -> Float[Array, ""]:
        """Highest local frequency of the light behind the mask along an axis, cycles/mm.

        Of bilinear heights |∂φ/∂x|/2π; of cells that of their pitch, 1/(2 pitch).
        """
        if self.interpolation == "cells":
            return 0.5 / self.pitch
        return _steepest(self.turns(wavelength)) / self.pitch

    def sample(self, grid: Grid, wavelength: Number | None = None) -> Complex[Array, "y x"]:
        if wavelength is None:
            raise TypeError("a PhaseMask delays light by its wavelength; give sample a wavelength")
        if self.interpolation == "cells":
            cells = turn_phasor(self.turns(wavelength))
            if self.amplitude is not None:
                cells = cells * as_complex(self.amplitude)
            shown = SampledMask(cells, self.pitch, centre=self.centre, fill_factor=self.fill_factor)
            return jnp.asarray(shown.sample(grid))
        y, x = grid.y - self.centre[0], grid.x - self.centre[1]
        turns = self._at(self.turns(wavelength), grid)
        if self.amplitude is None:
            down, across = (
                cell_overlap(at, grid.pitch, -side[None] / 2, side[None] / 2) / grid.pitch
                for at, side in zip((y, x), self.extent, strict=True)
            )
            passed = down * across.T
        else:
            passed = SampledMask(self.amplitude, self.pitch, centre=self.centre).sample(grid)
        return turn_phasor(turns) * as_complex(jnp.real(passed))

    def heights(self, grid: Grid) -> Float[Array, "y x"]:
        """Heights on a grid, mm: between the cells' centres, or the cells' mean in each sample."""
        if self.interpolation == "bilinear":
            return self._at(self.height, grid)
        return jnp.real(SampledMask(self.height, self.pitch, centre=self.centre).sample(grid))

    def _at(self, values: Float[Array, "n m"], grid: Grid) -> Float[Array, "y x"]:
        y, x = grid.y - self.centre[0], grid.x - self.centre[1]
        return _between(_between(values, y / self.pitch).T, x / self.pitch).T


class MaskBlank(Module):
    """Blank of a relief: its cells and its material.

    - `shape`: (rows, columns) of cells. `pitch`: side of the cells, mm.
    - `material`: refractive index, a number or one of `thincam_jax.imaging.refractive_index`.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import um

    blank = tc.lensless.masks.MaskBlank((24, 32), pitch=10 * um, material=1.5)
    mask = tc.lensless.masks.reliefs.diffuser(0, blank, correlation_length=50 * um, rms_slope=0.03)
    ```

    **See also**: `PhaseMask`, `lensless.masks.reliefs.diffuser`.
    """

    shape: tuple[int, int] = eqx.field(converter=quantity(check=checks.shape2d), static=True)
    pitch: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    material: AbstractIndex = eqx.field(converter=quantity(check=as_index))

    @property
    def grid(self) -> Grid:
        """The cells' centres."""
        return Grid(self.shape, self.pitch)

    def wrap_height(self, wavelength: Number) -> Float[Array, ""]:
        """λ/(n(λ) − 1), mm: the height that delays the light by one turn."""
        light = checks.wavelength("wavelength", wavelength)
        return light / (self.material(light) - 1)

    def mask(self, height: Any, interpolation: Interpolation = "cells") -> PhaseMask:
        """The blank with heights, mm: one for each of its cells."""
        mask = PhaseMask(height, self.pitch, self.material, interpolation=interpolation)
        if mask.height.shape != self.shape:
            raise ValueError(
                f"height has shape {mask.height.shape} and the blank {self.shape}; give as many"
            )
        return mask


@jax.jit
def _steepest(turns: Float[Array, "y x"]) -> Float[Array, ""]:
    """Largest step between neighbours, turns."""
    steps = [jnp.max(jnp.abs(jnp.diff(turns, axis=axis)), initial=0.0) for axis in (0, 1)]
    return jnp.maximum(*steps)


def _between(values: Float[Array, "n m"], at: Float[Array, " k"]) -> Float[Array, "k m"]:
    """Linear interpolation along the first axis, at centred indices; constant beyond the ends."""
    count = len(values)
    place = jnp.clip(at + (count - 1) / 2, 0.0, count - 1.0)
    below = jnp.clip(jnp.floor(place).astype(int), 0, max(count - 2, 0))
    part = (place - below.astype(place.dtype))[:, None]
    return values[below] * (1 - part) + values[jnp.minimum(below + 1, count - 1)] * part
