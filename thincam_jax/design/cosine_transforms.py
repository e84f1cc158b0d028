r"""Fourier transforms of the even and odd parts of an image, as real products.

A response that is even in both frequencies, as that of every mask here, keeps the parity of what it
acts on. So an image is taken apart once,

.. math:: f(\pm y, \pm x) = \sum_{a,b} (\pm 1)^a (\pm 1)^b f_{ab}(y, x), \qquad a, b \in \{0, 1\}

and transformed by cosines (0) and sines (1) of the places and frequencies that are not negative:
an eighth to a quarter of the multiplications of a product with complex exponentials over all of
them, and no complex numbers. Places and frequencies may be any, so that a spectrum can be taken
where it is wanted.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.checks import Number
from thincam_jax._core.grids import centred_indices
from thincam_jax._core.precision import product


def half_places(count: int, pitch: Number) -> Float[Array, " place"]:
    """Non-negative places among `count` centred samples, ascending, in the pitch's unit."""
    step = jnp.asarray(pitch)
    return centred_indices(count, step.dtype)[count // 2 :] * step


def fold(image: Float[Array, "y x"]) -> Float[Array, "2 2 half_y half_x"]:
    """Sums (0) and differences (1) of the samples at (±y, ±x), along each axis.

    Four times the parts above, so that a sum over these places is one over all; the middle line of
    an odd number of samples counts once.
    """
    return _fold(_fold(image, 0), 2).swapaxes(0, 1)


def unfold(parts: Float[Array, "2 2 half_y half_x"], shape: tuple[int, int]) -> Float[Array, "y x"]:
    """The image, of such a shape, with these parts."""
    return _unfold(_unfold(parts, shape[0], 2), shape[1], 2)


def waves(
    places: Float[Array, " place"], frequencies: Float[Array, " frequency"]
) -> Float[Array, "2 place frequency"]:
    """cos(2πxν) and sin(2πxν)."""
    phase = 2 * jnp.pi * places[:, None] * frequencies
    return jnp.stack([jnp.cos(phase), jnp.sin(phase)])


def transform(
    parts: Float[Array, "2 2 y x"], rows: Float[Array, "2 y v"], columns: Float[Array, "2 x u"]
) -> Float[Array, "2 2 v u"]:
    """Each part summed over the places with the waves of its parity."""
    across = product(parts, columns)
    return product(rows.swapaxes(-1, -2)[:, None], across)


def series(
    spectrum: Float[Array, "2 2 v u"], rows: Float[Array, "2 y v"], columns: Float[Array, "2 x u"]
) -> Float[Array, "2 2 y x"]:
    """Each part summed over the frequencies."""
    return transform(spectrum, rows.swapaxes(-1, -2), columns.swapaxes(-1, -2))


def both_signs(count: int) -> np.ndarray:
    """Multiplicity of each frequency 0 … N/2 in a sum over all N, an even number."""
    times = np.full(count // 2 + 1, 2.0)
    times[[0, -1]] = 1.0
    return times


def _fold(image, axis: int):
    """Even and odd part along an axis, stacked before the others."""
    count = image.shape[axis]
    half = (count + 1) // 2
    upper = jax.lax.slice_in_dim(image, count - half, count, axis=axis)
    lower = jnp.flip(jax.lax.slice_in_dim(image, 0, half, axis=axis), axis)
    once = np.ones([half if n == axis else 1 for n in range(image.ndim)])
    once.flat[0] = 0.5 if count % 2 else 1.0
    return jnp.stack([(upper + lower) * jnp.asarray(once, image.dtype), upper - lower])


def _unfold(parts, count: int, axis: int):
    """Array with these even and odd parts, given along the first axis, along `axis` of each."""
    even, odd = parts
    lower = jnp.flip(even - odd, axis - 1)
    lower = jax.lax.slice_in_dim(lower, 0, count // 2, axis=axis - 1)
    return jnp.concatenate([lower, even + odd], axis=axis - 1)
