r"""The linear step of ADMM: (KᵀMK)⁻¹ in the Fourier domain, for one plane and for several."""

import functools
import operator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core.precision import as_complex
from thincam_jax.imaging.operators import CropConvolution


class NormalInverse(eqx.Module):
    r"""The inverse of :math:`\mu_1 \sum_k H_k^* H_k^T + \mu_2 (\Lambda + \delta^2 D^T D) + \mu_3`.

    At each frequency the unknowns are the planes of the image. H_k is the vector of their transfer
    functions to the capture k, Λ the symbol of the differences along y and x, and D takes
    differences between planes. One plane: a division. Several: the cosine transform over the planes
    makes DᵀD diagonal, and each capture adds a term of rank one, which the formula of Sherman and
    Morrison inverts one after the other; nothing of the size planes² is kept.

    - `power`: Σ_k |H_k|², of one plane; None with several.
    - `depth_weight`: δ.
    """

    spectra: tuple[Complex[Array, "channel plane v u"], ...]
    power: Float[Array, "channel 1 v u"] | None
    depth_weight: Float[Array, ""]
    window: tuple[int, int] = eqx.field(static=True)

    def __init__(self, operators: tuple[CropConvolution, ...], gains, depth_weight):
        self.window = operators[0].window
        self.depth_weight = depth_weight
        if operators[0].spectrum.shape[-3] == 1:
            self.spectra = ()
            self.power = functools.reduce(
                operator.add,
                [g**2 * squared_modulus(o.spectrum) for o, g in zip(operators, gains, strict=True)],
            )
        else:
            self.spectra = tuple(
                _to_modes(o.spectrum * g.astype(o.spectrum.dtype))
                for o, g in zip(operators, gains, strict=True)
            )
            self.power = None

    def __call__(
        self, spectrum: Complex[Array, "*batch channel plane v u"], penalties
    ) -> Complex[Array, "*batch channel plane v u"]:
        smooth = penalties.variation * difference_symbol(self.window, spectrum.real.dtype)
        if self.power is not None:
            inverse = 1 / (penalties.data * self.power + smooth + penalties.image)
            # By real factors, of which a gradient keeps no complex copy.
            return jax.lax.complex(spectrum.real * inverse, spectrum.imag * inverse)
        planes = spectrum.shape[-3]
        depth = penalties.variation * self._depth_symbol(planes, smooth.dtype)
        inverse = 1 / (smooth + depth[:, None, None] + penalties.image)
        inverse = as_complex(inverse)
        return _from_modes(self._rank_ones(_to_modes(spectrum), inverse, penalties.data))

    def _depth_symbol(self, planes: int, dtype):
        """Eigenvalues of δ²DᵀD, whose eigenvectors are the cosines."""
        angles = np.pi * np.arange(planes) / planes
        return self.depth_weight.astype(dtype) ** 2 * jnp.asarray(2 - 2 * np.cos(angles), dtype)

    def _rank_ones(self, spectrum, inverse, mu):
        """(A + μ Σ_k h_k h_kᴴ)⁻¹ applied, A⁻¹ = `inverse` diagonal in the modes."""
        columns = []  # A_{k-1}⁻¹ h_k, and 1/μ + h_kᴴ A_{k-1}⁻¹ h_k

        def apply(vector, used):
            result = vector * inverse
            for h, column, size in used:
                result = result - column * (_inner(h, result) / size)
            return result

        for spectra in self.spectra:
            h = spectra.conj()
            column = apply(h, columns)
            size = (1 / mu).astype(h.dtype) + _inner(h, column)
            columns.append((h, column, size))
        return apply(spectrum, columns)


def or_one(value: Float[Array, "..."]) -> Float[Array, "..."]:
    """A divisor: the value where it is positive, else 1."""
    return jnp.where(value > 0, value, 1)


def squared_modulus(spectrum: Complex[Array, "..."]) -> Float[Array, "..."]:
    return spectrum.real**2 + spectrum.imag**2


def mean_power(operator: CropConvolution) -> Float[Array, ""]:
    """Mean of |H|² over the whole plane of frequencies, the channels and the planes."""
    power = squared_modulus(operator.spectrum)
    # The half plane of a real transform leaves out the mirror images of its inner columns.
    columns = operator.window[1]
    whole = 2 * jnp.sum(power, axis=-1) - power[..., 0]
    if columns % 2 == 0:
        whole = whole - power[..., -1]
    return jnp.mean(whole) / columns


def difference_symbol(window: tuple[int, int], dtype) -> Float[Array, "v u"]:
    """4 sin²(πv) + 4 sin²(πu) on the half plane of a real transform: that of ΨᵀΨ."""
    v, u = np.fft.fftfreq(window[0]), np.fft.rfftfreq(window[1])
    down, right = (jnp.asarray(4 * np.sin(np.pi * f) ** 2, dtype) for f in (v, u))
    return down[:, None] + right


def _inner(a, b):
    return jnp.sum(a.conj() * b, axis=-3, keepdims=True)


def _cosines(planes: int) -> np.ndarray:
    """The orthonormal DCT-II: (mode, plane)."""
    mode, plane = np.ogrid[:planes, :planes]
    matrix = np.cos(np.pi * mode * (plane + 0.5) / planes) * np.sqrt(2 / planes)
    matrix[0] /= np.sqrt(2)
    return matrix


def _to_modes(spectrum):
    matrix = jnp.asarray(_cosines(spectrum.shape[-3]), spectrum.dtype)
    return jnp.einsum("mp,...pvu->...mvu", matrix, spectrum)


def _from_modes(spectrum):
    matrix = jnp.asarray(_cosines(spectrum.shape[-3]), spectrum.dtype)
    return jnp.einsum("mp,...mvu->...pvu", matrix, spectrum)
