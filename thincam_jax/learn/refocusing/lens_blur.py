"""Blur of a lens for a plane that is out of focus: uniform discs."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core.grids import centred_indices, fast_shape
from thincam_jax.imaging.operators.crop_convolution import cut, place


def lens_blur(
    images: Float[Array, "*plane y x"], radius: Float[Array, "*plane"], largest: int
) -> Float[Array, "*plane y x"]:
    """Images averaged over discs of these radii, pixels; the scene is dark beside its frame.

    A disc's samples are weighted by how much of them it covers, to first order, and sum to 1. At
    a radius of half a pixel or less the image stays as it is.

    `largest`: pixels from its middle that the widest disc reaches.
    """
    rows, columns = images.shape[-2:]
    along = centred_indices(2 * largest + 1, images.dtype)
    distance = jnp.sqrt(along[:, None] ** 2 + along**2)
    discs = jnp.clip(radius[..., None, None] + 0.5 - distance, 0, 1)
    # The middle sample is covered whole by any disc.
    discs = discs.at[..., largest, largest].set(1)
    discs = discs / jnp.sum(discs, axis=(-2, -1), keepdims=True)
    window = fast_shape((rows + 2 * largest, columns + 2 * largest), real=True)
    spectrum = jnp.fft.rfft2(place(images, (0, 0), window)) * jnp.fft.rfft2(
        place(discs, (0, 0), window)
    )
    return cut(jnp.fft.irfft2(spectrum, s=window), (largest, largest), (rows, columns))
