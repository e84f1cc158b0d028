"""An image that is a short sum of separable terms: how the closed-form PSFs are kept and used."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Complex, DTypeLike, Float

from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import as_complex, product, turn_phasor


class SeparableSum(eqx.Module):
    """The image Σ_m Re{ Y_m(y) X_m(x) }.

    A PSF of a square Fresnel zone aperture has this form with a handful of terms, because |U|² of
    a sum of separable fields is again one. Image, pixel average and OTF then cost one-dimensional
    work and one real matrix product, in place of two-dimensional transforms.

    - `rows`: Y_m on the rows, with all constant factors.
    - `columns`: X_m on the columns.
    - `grid`: where the samples lie.
    """

    rows: Complex[Array, "term y"]
    columns: Complex[Array, "term x"]
    grid: Grid

    def image(self) -> Float[Array, "y x"]:
        """The image on the grid."""
        rows, columns = self.real_factors()
        return product(rows.T, columns)

    def transform(self) -> Complex[Array, "v u"]:
        """Fourier transform ∬ h e^{−2πj(ux+vy)} dx dy on the grid's centred frequencies, mm².

        The integral over the sampled area, as the sum of the samples times pitch².
        """
        rows, columns = (_centred_dft(factor) for factor in self.real_factors())
        return product(rows.T, columns) * as_complex(self.grid.pitch**2)

    def real_factors(self) -> tuple[Float[Array, "factor y"], Float[Array, "factor x"]]:
        """Real Y_f and X_f with h = Σ_f Y_f(y) X_f(x), twice as many as there are terms."""
        # Re{YX} = Re Y Re X − Im Y Im X: one real product in place of a complex one.
        rows = jnp.concatenate([self.rows.real, -self.rows.imag])
        return rows, jnp.concatenate([self.columns.real, self.columns.imag])


def _centred_dft(samples: Float[Array, "factor n"]) -> Complex[Array, "factor n"]:
    """Σ_i f_i e^{−2πj u (i−(n−1)/2)}, zero frequency at n//2."""
    n = samples.shape[-1]
    spectrum = jnp.fft.fftshift(jnp.fft.fft(samples, axis=-1), axes=-1)
    return spectrum * centre_phase(n, samples.dtype)


def centre_phase(count: int, dtype: DTypeLike) -> Complex[Array, " count"]:
    """e^{2πj u (n−1)/2} on the centred DFT frequencies: moves the origin to the grid's centre."""
    turns = (jnp.arange(count, dtype=dtype) - count // 2) * ((count - 1) / (2 * count))
    return turn_phasor(turns)
