"""Images enlarged and moved, differentiable in both: separable Lanczos interpolation."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._precision import product
from thincam_jax.grids import centred_indices

LOBES = 4  # of the kernel on either side; below 0.3 cycles/pixel it is 1e-3 off


def resample(
    image: Float[Array, "y x"], scale: Float[Array, ""], shift: Float[Array, "2"]
) -> Float[Array, "y x"]:
    """image((r − shift)/scale) on the image's own pixels, r in pixels from the middle.

    The image is enlarged about its middle by `scale`, then moved by `shift` (y, x). Beyond its
    edges the outermost pixels count for more; use `covered` to leave that out. A scale well under 1
    aliases what is finer than the enlarged pixels.
    """
    rows, columns = (
        _weights(count, scale, offset) for count, offset in zip(image.shape, shift, strict=True)
    )
    return product(product(rows, image), columns.T)


def covered(
    shape: tuple[int, int], scale: Float[Array, ""], shift: Float[Array, "2"], margin: int
) -> Float[Array, "y x"]:
    """1 where a resampled image comes from inside, `margin` pixels off the edge, 0 elsewhere.

    The border of the result, `margin` wide, is left out as well.
    """
    sides = []
    for count, offset in zip(shape, shift, strict=True):
        r = centred_indices(count, scale.dtype)
        reach = (count - 1) / 2 - margin
        inside = (jnp.abs((r - offset) / scale) <= reach) & (jnp.abs(r) <= reach)
        sides.append(inside.astype(scale.dtype))
    return sides[0][:, None] * sides[1]


def _weights(count: int, scale, offset) -> Float[Array, "n n"]:
    """Interpolation along an axis: rows sum to one."""
    r = centred_indices(count, scale.dtype)
    distance = ((r - offset) / scale)[:, None] - r
    within = jnp.abs(distance) < LOBES
    distance = jnp.where(within, distance, 0.0)
    kernel = jnp.where(within, jnp.sinc(distance) * jnp.sinc(distance / LOBES), 0.0)
    total = jnp.sum(kernel, axis=1, keepdims=True)
    return kernel / jnp.where(jnp.abs(total) > 0.5, total, 1.0)
