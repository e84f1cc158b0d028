"""Where objects stand in front of others: random shapes, never tied to the frame.

All random numbers are arguments, uniform from 0 to 1: one draw for a scene compiles far faster
than one for each.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax._core.grids import centred_indices

_WAVES = 6
RELIEF_NUMBERS = 3 * _WAVES
COVER_NUMBERS = RELIEF_NUMBERS + 9


def random_cover(numbers: Float[Array, " number"], shape: tuple[int, int]) -> Float[Array, "y x"]:
    """Part of each pixel that an object covers, 0 to 1, with edges soft over about a pixel.

    With equal chances a turned ellipse or rectangle somewhere, a half plane of any direction, or
    blobs: where a sum of long waves is above a level. `numbers`: `COVER_NUMBERS` of them.
    """
    placed, wavy = numbers[:9], numbers[9:COVER_NUMBERS]
    rows, columns = shape
    unit = max(shape) / 2
    y = centred_indices(rows, numbers.dtype)[:, None] / unit
    x = centred_indices(columns, numbers.dtype)[None] / unit
    levels = jnp.stack([_object(placed, y, x), _half(placed, y, x), _blobs(wavy, placed[0], y, x)])
    level = levels[jnp.minimum((3 * placed[7]).astype(int), 2)]
    softness = (0.4 + 1.1 * placed[8]) / unit
    return jnp.clip(level / softness + 0.5, 0, 1)


def random_relief(numbers: Float[Array, " number"], shape: tuple[int, int]) -> Float[Array, "y x"]:
    """A smooth map from −1 to 1, slanted or curved surfaces; of `RELIEF_NUMBERS` numbers."""
    rows, columns = shape
    y = (jnp.arange(rows, dtype=numbers.dtype) / rows)[:, None]
    x = (jnp.arange(columns, dtype=numbers.dtype) / columns)[None]
    waves = _waves(numbers, y, x, 1.0)
    low, high = jnp.min(waves), jnp.max(waves)
    return 2 * (waves - low) / jnp.where(high > low, high - low, 1) - 1


def _object(placed, y, x):
    """Signed distance to a superellipse's edge, about, in half images."""
    centre = 1.6 * placed[:2] - 0.8
    radii = 0.2 * 4 ** placed[2:4]
    angle = jnp.pi * placed[4]
    power = jnp.where(placed[5] < 0.5, 2.0, 10.0).astype(radii.dtype)
    down, across = y - centre[0], x - centre[1]
    u = (across * jnp.cos(angle) + down * jnp.sin(angle)) / radii[0]
    v = (down * jnp.cos(angle) - across * jnp.sin(angle)) / radii[1]
    norm = (jnp.abs(u) ** power + jnp.abs(v) ** power) ** (1 / power)
    return (1 - norm) * jnp.min(radii)


def _half(placed, y, x):
    turn = 2 * jnp.pi * placed[4]
    return x * jnp.cos(turn) + y * jnp.sin(turn) - (placed[6] - 0.5)


def _blobs(wavy, level, y, x):
    # Divided by a typical slope: about a distance.
    return (_waves(wavy, y, x, 0.8) - (1.5 * level - 0.5)) / 5


def _waves(numbers, y, x, highest):
    """A sum of cosines of up to `highest` cycles per unit, of variance 1."""
    v, u, start = numbers.reshape(3, _WAVES, 1, 1)
    turns = highest * ((2 * v - 1) * y + (2 * u - 1) * x) + start
    return jnp.sum(jnp.cos(2 * jnp.pi * turns), axis=0) * (2 / _WAVES) ** 0.5
