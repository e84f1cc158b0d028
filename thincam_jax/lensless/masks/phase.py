"""Phase masks: reliefs of a transparent material that delay the light; diffusers and lenslets."""

import functools
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Complex, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number
from thincam_jax._core.grids import Grid, cell_overlap, fast_shape
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax._core.module import Module
from thincam_jax._core.precision import as_complex, turn_phasor
from thincam_jax._core.quantity import choice, quantity
from thincam_jax._core.random import Key, random_key
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
    the others (`thincam_jax.lensless.resolve.require_phase_sampling`).

    **Errors**: ValueError or TypeError, one line, for what is out of range.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import um

    import numpy as np

    steps = np.tile([0.0, 0.5e-3], (24, 16))  # heights, mm
    mask = tc.PhaseMask(steps, pitch=10 * um, material=1.5)
    ```

    **See also**: `lensless.masks.MaskBlank`, `lensless.masks.phase.diffuser`.
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
    mask = tc.lensless.masks.phase.diffuser(0, blank, correlation_length=50 * um, rms_slope=0.03)
    ```

    **See also**: `PhaseMask`, `lensless.masks.phase.diffuser`.
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


# Correlation lengths beyond the map, so that its opposite rims know nothing of each other.
_APART = 4.0


@checked
def diffuser(
    key: Key, blank: MaskBlank, *, correlation_length: Number, rms_slope: Number
) -> PhaseMask:
    r"""A diffuser: Gaussian random heights, between whose samples is interpolated.

    Their autocovariance is :math:`\sigma^2 e^{-r^2/\ell^2}`, so that the slope along an axis has
    the root mean square :math:`s = \sqrt2\,\sigma/\ell`: it bends light by about (n − 1)s. Its
    bumps have the rms curvature :math:`2\sqrt3\,\sigma/\ell^2`, and caustics are sharp near their
    focal length :math:`\ell/[\sqrt6\,(n-1)s]`.

    - `key`: key of `jax.random`, or a seed.
    - `correlation_length`: ℓ, mm, at least two cells.
    - `rms_slope`: s along an axis, dimensionless. The lowest height is 0.

    ```python
    from thincam_jax.lensless.masks import MaskBlank
    from thincam_jax.lensless.masks.phase import diffuser
    from thincam_jax.units import um

    blank = MaskBlank((24, 32), pitch=10 * um, material=1.5)
    mask = diffuser(0, blank, correlation_length=50 * um, rms_slope=0.03)
    print(mask.height.shape)  # (24, 32)
    ```

    **See also**: `PhaseMask`, `lensless.masks.phase.voronoi_fresnel`.
    """
    length = checks.positive("correlation_length", correlation_length, "mm")
    slope = checks.positive("rms_slope", rms_slope, "a ratio")
    cells = float(length / blank.pitch)
    if cells < 2:
        raise ValueError(
            f"correlation_length = {float(length):g} mm is {cells:.2g} cells of the blank; give at "
            f"least {2 * float(blank.pitch):g} mm, or smaller cells"
        )
    rows, columns = (n + int(np.ceil(_APART * cells)) for n in blank.shape)
    needed = 32 * rows * columns
    refuse_if_too_large("this diffuser", needed, "give a shorter correlation_length")
    window = fast_shape((rows, columns))
    v, u = (jnp.asarray(np.fft.fftfreq(n), length.dtype) / blank.pitch for n in window)
    # A Gaussian of width ℓ/√2 convolved with itself has the width ℓ.
    kernel = jnp.exp(-((jnp.pi * length) ** 2) * (v[:, None] ** 2 + u**2) / 2)
    kernel = kernel / jnp.sqrt(jnp.mean(kernel**2))
    noise = jax.random.normal(random_key(key), window, length.dtype)
    height = jnp.real(jnp.fft.ifft2(jnp.fft.fft2(noise) * as_complex(kernel)))
    height = height[: blank.shape[0], : blank.shape[1]] * (slope * length / jnp.sqrt(2.0))
    return blank.mask(height - jnp.min(height), "bilinear")


@checked
def voronoi_fresnel(
    key: Key,
    blank: MaskBlank,
    *,
    sites: int,
    focal_length: Number,
    wavelength: Number,
    relaxations: int = 20,
) -> PhaseMask:
    r"""Fresnel lenses in Voronoi cells, every one focused on the sensor (Fu et al., 2022).

    The cell of the site s holds the phase :math:`-\frac{2\pi}\lambda(\sqrt{|r-s|^2+f^2}-f)`,
    wrapped to one turn, 0 ≤ h < λ/(n − 1). Lloyd's relaxation moves random sites to the
    centroids of their cells: these become even in size and round, and the PSF a set of equal,
    unevenly spaced points (Optics Express 30, 45807).

    - `key`: key of `jax.random`, or a seed. `sites`: number of lenses. `relaxations`: steps of
      Lloyd's.
    - `focal_length`: f, mm: the mask-sensor distance for far objects.
    - `wavelength`: wavelength that the lenses are designed for, mm.

    **Sampling.** The rim of a lens turns the phase by r/(λf) cycles/mm, which the cells hold up to
    1/(2 pitch): lenses that reach farther are refused.

    ```python
    from thincam_jax.lensless.masks import MaskBlank
    from thincam_jax.lensless.masks.phase import voronoi_fresnel
    from thincam_jax.units import nm, um

    blank = MaskBlank((24, 32), pitch=10 * um, material=1.5)
    mask = voronoi_fresnel(0, blank, sites=3, focal_length=6.0, wavelength=550 * nm)
    ```

    **See also**: `PhaseMask`, `LensletArray`.
    """
    if not 1 <= sites <= blank.shape[0] * blank.shape[1]:
        raise ValueError(f"sites = {sites}; give 1 to the number of cells of the blank")
    focal_length = checks.positive("focal_length", focal_length, "mm")
    light = checks.wavelength("wavelength", wavelength)
    y, x = (np.asarray(a, float) for a in (blank.grid.y, blank.grid.x))
    cells = np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1).reshape(-1, 2)
    half = np.array(blank.shape) * float(blank.pitch) / 2
    places = jax.random.uniform(random_key(key), (sites, 2), minval=-1.0, maxval=1.0)
    places = np.asarray(places) * half
    places = relaxed_sites(places, cells, relaxations)
    squared = scipy.spatial.KDTree(places).query(cells)[0].reshape(blank.shape) ** 2
    _require_held(blank, float(np.sqrt(squared.max())), float(focal_length), float(light))
    f = float(focal_length)
    turns = -squared / (np.sqrt(squared + f**2) + f) / float(light)
    turns = jnp.asarray(turns - np.floor(turns), focal_length.dtype)
    return blank.mask(turns * blank.wrap_height(light))


def relaxed_sites(
    sites: Float[np.ndarray, "site 2"], cells: Float[np.ndarray, "cell 2"], steps: int
) -> Float[np.ndarray, "site 2"]:
    """Sites moved to the centroids of their cells in steps of Lloyd's relaxation."""
    for _ in range(steps):
        owner = scipy.spatial.KDTree(sites).query(cells)[1]
        count = np.bincount(owner, minlength=len(sites))[:, None]
        sums = [np.bincount(owner, cells[:, axis], len(sites)) for axis in (0, 1)]
        sites = np.where(count > 0, np.stack(sums, axis=-1) / np.maximum(count, 1), sites)
    return sites


def _require_held(blank: MaskBlank, reach: float, focal_length: float, wavelength: float) -> None:
    frequency = reach / np.hypot(reach, focal_length) / wavelength
    nyquist = 0.5 / float(blank.pitch)
    if frequency > nyquist:
        raise ValueError(
            f"a lens reaches {reach:.3g} mm from its centre, where its phase has {frequency:.3g} "
            f"cycles/mm, and cells of {float(blank.pitch):g} mm hold {nyquist:.3g}: give more "
            "sites, a longer focal_length or smaller cells"
        )
