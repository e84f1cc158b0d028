r"""Sparsity in an orthonormal basis as a regulariser: few wavelets, or few cosines."""

import equinox as eqx
import jax.numpy as jnp
import jax.scipy.fft
import numpy as np
from jaxtyping import Array, Bool, Float

from thincam_jax.reconstruction.regulariser import AbstractRegulariser
from thincam_jax.reconstruction.wavelet import Wavelet


class Cosines(eqx.Module):
    """The orthonormal discrete cosine transform (DCT-II) over the last two axes."""

    def analyse(self, image: Float[Array, "*batch y x"]) -> Float[Array, "*batch y x"]:
        """The coefficients of an image, zero frequency first."""
        return jax.scipy.fft.dctn(image, axes=(-2, -1), norm="ortho")

    def synthesise(self, coefficients: Float[Array, "*batch y x"]) -> Float[Array, "*batch y x"]:
        """The image of coefficients: the transpose and inverse of `analyse`."""
        return jax.scipy.fft.idctn(coefficients, axes=(-2, -1), norm="ortho")

    def coarse_shape(self, shape: tuple[int, int]) -> tuple[int, int]:
        """The mean is one coefficient."""
        return 1, 1


class Sparsity(AbstractRegulariser):
    r"""R(f) = Σ |details of f| in an orthonormal basis, each plane and channel by itself.

    The coarse coefficients (of cosines: the mean) are free, so that an even image costs nothing and
    its brightness is not drawn to zero. R is a seminorm.

    - `basis`: `Wavelet` or `Cosines`.
    """

    basis: Wavelet | Cosines

    def __init__(self, basis: Wavelet | Cosines | None = None):
        self.basis = Wavelet() if basis is None else basis

    @property
    def orthonormal(self):
        return True

    def __call__(self, image):
        (details,) = self.analyse(image)
        counted = jnp.where(self._free(details.shape), 0, jnp.abs(details))
        return jnp.sum(counted, axis=(-4, -3, -2, -1))

    def analyse(self, image):
        return (self.basis.analyse(image),)

    def synthesise(self, parts):
        return self.basis.synthesise(parts[0])

    def shrink(self, parts, step):
        (details,) = parts
        shrunk = jnp.sign(details) * jnp.maximum(jnp.abs(details) - step, 0)
        return (jnp.where(self._free(details.shape), details, shrunk),)

    def squared_norm(self, dtype):
        return jnp.ones((), dtype)

    def _free(self, shape) -> Bool[Array, "y x"]:
        """Where the coarse coefficients stand."""
        sizes = zip(shape[-2:], self.basis.coarse_shape(shape[-2:]), strict=True)
        y, x = (jnp.asarray(np.arange(n) < coarse) for n, coarse in sizes)
        return y[:, None] & x
