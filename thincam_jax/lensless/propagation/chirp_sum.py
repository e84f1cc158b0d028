r"""Sums of unbounded chirps, exactly: the PSFs and OTFs of masks without an edge."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import as_complex, phasor, turn_phasor
from thincam_jax.lensless.propagation.chirp import chirp_average
from thincam_jax.lensless.propagation.separable_sum import SeparableSum


class ChirpSum(eqx.Module):
    r"""The image :math:`\sum_m \mathrm{Re}\{ w_m e^{j\gamma_m |\mathbf r - \mathbf r_0|^2} \}`.

    - `weights`: w_m.
    - `curvatures`: γ_m on the sensor, rad/mm²; 0 is a constant.
    - `centre`: (y, x) of r₀ on the sensor, mm.
    """

    weights: Complex[Array, " term"]
    curvatures: Float[Array, " term"]
    centre: Float[Array, "2"]

    def sample(self, grid: Grid, *, pixel_integration: bool) -> SeparableSum:
        """Samples at a grid's pixel centres, or averaged over its pixels (Fresnel integrals)."""
        # Both axes at once: half as much to compile.
        points = jnp.concatenate([grid.y - self.centre[0], grid.x - self.centre[1]])
        curvatures = self.curvatures[:, None]
        if pixel_integration:
            both = chirp_average(curvatures, points, grid.pitch / 2) * as_complex(1 / grid.pitch)
        else:
            both = phasor(curvatures * points**2)
        rows, columns = jnp.split(both, [grid.shape[0]], axis=-1)
        return SeparableSum(self.weights[:, None] * rows, columns, grid)

    def transform(self, grid: Grid) -> Complex[Array, "v u"]:
        r"""Fourier transform on the grid's centred frequencies, mm².

        :math:`\mathcal F\,\mathrm{Re}\{w e^{j\gamma r^2}\} = \mathrm{Re}\{ w\,(j\pi/\gamma)
        e^{-j\pi^2\rho^2/\gamma}\}` (thesis Eq 3.11, 3.12 with the corrected constants). A constant
        w is w·δ(u,v); on the grid δ is one over the area of a frequency cell.
        """
        constant = self.curvatures == 0
        gamma = jnp.where(constant, 1.0, self.curvatures)[:, None]
        quadrature = jax.lax.complex(jnp.zeros_like(self.curvatures), jnp.pi / gamma[:, 0])
        weights = jnp.where(constant, 0.0, self.weights * quadrature)
        rows = phasor(-(jnp.pi**2) * grid.v**2 / gamma)
        columns = phasor(-(jnp.pi**2) * grid.u**2 / gamma)
        chirps = SeparableSum(weights[:, None] * rows, columns, grid).image()
        area = grid.shape[0] * grid.shape[1] * grid.pitch**2
        delta = jnp.sum(jnp.where(constant, self.weights.real, 0.0)) * area
        spectrum = chirps.at[grid.shape[0] // 2, grid.shape[1] // 2].add(delta)
        shift = turn_phasor(-grid.v * self.centre[0])[:, None] * turn_phasor(
            -grid.u * self.centre[1]
        )
        return as_complex(spectrum) * shift


def gather_constants(
    constant: Bool[np.ndarray, " pair"],
    weights: Complex[Array, " pair"],
    curvatures: Float[Array, " pair"],
) -> tuple[Complex[Array, " term"], Float[Array, " term"]]:
    """One term for all pairs of an order with itself, which have no fringes."""
    total = jnp.sum(weights[constant], keepdims=True)
    none = jnp.zeros(1, curvatures.dtype)
    return (
        jnp.concatenate([total, weights[~constant]]),
        jnp.concatenate([none, curvatures[~constant]]),
    )
