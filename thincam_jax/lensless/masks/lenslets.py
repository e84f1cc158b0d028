"""Lenslet arrays, exactly: a lens is a chirp along each axis."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number
from thincam_jax._core.precision import as_complex
from thincam_jax._core.quantity import quantity
from thincam_jax.lensless.masks.base import AbstractFactoredMask, AxisFactors, MaskTerms
from thincam_jax.lensless.masks.cells import cell_edges


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

    **See also**: `lensless.masks.reliefs.voronoi_fresnel`.
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
