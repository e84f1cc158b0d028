"""A pixel's average as the mean over the points of a lattice."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def pixel_mean(
    value: Callable[[Float[Array, "2"]], Float[Array, "y x"]], count: int, dark: Float[Array, "y x"]
) -> Float[Array, "y x"]:
    """Mean over `count` points of each pixel of the image at a point; `dark` is an image of 0."""
    places = jnp.asarray(lattice(count), dark.dtype)
    total, _ = jax.lax.scan(lambda total, place: (total + value(place), None), dark, places)
    return total / count


def lattice(count: int) -> Float[np.ndarray, "point 2"]:
    """Points (u, frac(g·u)), u = (i + ½)/count, of a rank-1 lattice about the pixel's centre.

    g is odd, has no divisor in common with the count and is next to count/golden ratio or its
    complement: of Fibonacci numbers, the best lattice (Niederreiter, CBMS-NSF 63 (1992), ch. 5).
    Odd, so that the points turned by 180° are the points.
    """
    golden = (math.sqrt(5) - 1) / 2 * count
    odd = [g for g in range(1, max(count, 2), 2) if math.gcd(g, count) == 1]
    generator = min(odd, key=lambda g: min(abs(g - golden), abs(count - g - golden)))
    first = (np.arange(count) + 0.5) / count
    return np.stack([first, first * generator % 1], axis=-1) - 0.5
