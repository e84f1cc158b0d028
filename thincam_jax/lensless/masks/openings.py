"""Openings: the pinhole, square or round, the round code of rings, and arrays of lenslets."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number
from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import as_complex
from thincam_jax._core.quantity import quantity
from thincam_jax.lensless.masks.base import (
    AbstractFactoredMask,
    AbstractMask,
    AxisFactors,
    MaskTerms,
)
from thincam_jax.lensless.masks.cells import cell_edges


class Pinhole(AbstractFactoredMask):
    """A square or rectangular opening in an opaque sheet.

    **Arguments**

    - `width`: side, mm; of a rectangle that along x.
    - `height`: side of a rectangle along y, mm; None for a square.
    - `centre`: (y, x) of the opening's centre, mm.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    camera = tc.LenslessCamera(tc.Pinhole(0.5), tc.Sensor((24, 32), 50 * um), distance=5.0)
    h = tc.psf(camera, wavelength=500 * nm)
    ```

    **See also**: `RadialMask`.
    """

    width: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    height: Float[Array, ""] | None = eqx.field(
        default=None, converter=quantity("mm", positive=True, optional=True)
    )
    centre: Float[Array, "2"] = eqx.field(
        default=(0, 0), converter=quantity("mm", shape=(2,)), kw_only=True
    )

    @property
    def extent(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        return self.width if self.height is None else self.height, self.width

    def terms(self, wavelength: Number | None = None) -> MaskTerms:
        one = as_complex(jnp.ones((1, 1), self.width.dtype))
        rows, columns = (AxisFactors(jnp.stack([-s / 2, s / 2]), one) for s in self.extent)
        return MaskTerms(one[0], columns if self.height is None else rows, columns)


def _widths(name: str, value: Any) -> checks.Checked:
    """One width, or an array of them, mm."""
    if checks.shape_of(value) == ():
        return checks.positive(name, value, "mm")
    return checks.positive_all(name, value, "mm")


class RadialMask(AbstractMask):
    r"""A code of concentric rings, the same in all directions; of one value, a round pinhole.

    With rings between the radii √(nπ/β) it is a round binary zone plate. No sum of few products:
    its exact PSF is that of `radial`. On the axis behind an opening of radius a lies the irradiance
    :math:`4\sin^2(\pi a^2/(2\lambda d))`.

    **Arguments**

    - `rings`: amplitude transmittance of each ring, 0 to 1, from the middle outwards.
    - `ring`: width of a ring, mm; or of each, from the middle outwards.
    - `centre`: (y, x) of the mask's centre, mm.

    ```python
    import thincam_jax as tc

    mask = tc.RadialMask([1, 0, 1], ring=0.1)  # open to 0.1 mm and from 0.2 to 0.3 mm
    ```

    **See also**: `Pinhole`.
    """

    rings: Float[Array, " ring"] = eqx.field(converter=quantity(check=checks.transmittances))
    ring: Float[Array, "*ring"] = eqx.field(converter=quantity("mm", check=_widths))
    centre: Float[Array, "2"] = eqx.field(
        default=(0, 0), converter=quantity("mm", shape=(2,)), kw_only=True
    )
    exact_model = "radial"

    def __check_init__(self):
        if self.ring.shape not in ((), self.rings.shape):
            raise ValueError(
                f"ring has shape {self.ring.shape}; give one width, or one for each of "
                f"{self.rings.size} rings"
            )

    @property
    def radii(self) -> Float[Array, " ring"]:
        """Outer radius of each ring, mm."""
        if self.ring.ndim:
            return jnp.cumsum(self.ring)
        return jnp.arange(1, self.rings.size + 1, dtype=self.ring.dtype) * self.ring

    @property
    def extent(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        side = 2 * self.radii[-1]
        return side, side

    @property
    def finest_frequency(self) -> Float[Array, ""]:
        """Frequency of alternating rings, cycles/mm."""
        return 0.5 / jnp.min(self.ring)

    def sample(self, grid: Grid, wavelength: Number | None = None) -> Float[Array, "y x"]:
        """Every sample's mean over its square, exactly."""
        y, x = (
            jnp.append(points - grid.pitch / 2, points[-1] + grid.pitch / 2) - middle
            for points, middle in zip((grid.y, grid.x), self.centre, strict=True)
        )
        total = jnp.zeros(grid.shape, self.ring.dtype)
        steps = -jnp.diff(self.rings, append=0)
        for number, radius in enumerate(self.radii):
            area = _disc_area(radius, y[:, None], x)
            total = total + steps[number] * jnp.diff(jnp.diff(area, axis=0), axis=1)
        return total / grid.pitch**2


def _disc_area(radius, y, x):
    """Signed area of a disc's part between the axes through its centre and the lines at y and x."""
    sign = jnp.sign(y) * jnp.sign(x)
    crosses = jnp.abs(y) < radius  # elsewhere no root, whose derivative at 0 is infinite
    chord = jnp.where(crosses, jnp.sqrt(radius**2 - jnp.where(crosses, y, 0.0) ** 2), 0.0)
    y, x = jnp.minimum(jnp.abs(y), radius), jnp.minimum(jnp.abs(x), radius)
    at = jnp.minimum(x, chord)

    def below_circle(x):
        """∫₀ˣ √(R² − ξ²) dξ."""
        u = jnp.minimum(x / radius, 1.0)
        safe = jnp.where(u < 1, u, 0.0)
        curve = safe * jnp.sqrt(1 - safe**2) + jnp.arcsin(safe)
        return radius**2 / 2 * jnp.where(u < 1, curve, np.pi / 2)

    return sign * (y * at + below_circle(x) - below_circle(at))


class LensletArray(AbstractFactoredMask):
    r"""Square thin lenses side by side, without gaps.

    .. math:: t(x, y) = \exp\Big\{-\frac{j\pi}{\lambda f} [(x - x_i)^2 + (y - y_j)^2]\Big\}

    within the lens (i, j): a product of a function of x and one of y, of rank 1 for any number of
    lenses. The focal length is the same for all wavelengths.

    **Arguments**

    - `focal_length`: f, mm, > 0.
    - `pitch`: side of a lens, mm.
    - `shape`: lenses (down, across).
    - `centre`: (y, x) of the array's centre, mm.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.LensletArray(focal_length=5.0, pitch=0.5, shape=(2, 3))
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    h = tc.psf(camera, wavelength=500 * nm)
    ```

    **See also**: `lensless.masks.phase.voronoi_fresnel`.
    """

    focal_length: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    pitch: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    shape: tuple[int, int] = eqx.field(
        default=(1, 1), converter=quantity(check=checks.shape2d), static=True
    )
    centre: Float[Array, "2"] = eqx.field(
        default=(0, 0), converter=quantity("mm", shape=(2,)), kw_only=True
    )

    @property
    def extent(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        return self.shape[0] * self.pitch, self.shape[1] * self.pitch

    @property
    def pure_phase(self) -> bool:
        return True

    def terms(self, wavelength: Number | None = None) -> MaskTerms:
        if wavelength is None:
            raise ValueError("a LensletArray bends light by its wavelength; give wavelength in mm")
        curvatures = jnp.reshape(-jnp.pi / wavelength / self.focal_length, 1)
        rows, columns = (self._factors(count, curvatures) for count in self.shape)
        one = as_complex(jnp.ones(1, self.pitch.dtype))
        return MaskTerms(one, columns if self.shape[0] == self.shape[1] else rows, columns)

    def _factors(self, count: int, curvatures: Float[Array, "1"]) -> AxisFactors:
        edges = cell_edges(count, self.pitch)
        values = as_complex(jnp.ones((1, count), self.pitch.dtype))
        return AxisFactors(edges, values, curvatures, (edges[1:] + edges[:-1]) / 2)
