"""Where objects stand in front of others: random shapes, never tied to the frame."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

_WAVES = 6


def random_cover(key: PRNGKeyArray, shape: tuple[int, int]) -> Float[Array, "y x"]:
    """How much of each pixel an object covers, 0 to 1, with edges soft over about a pixel.

    With equal chances a turned ellipse or rectangle somewhere, a half plane of any direction, or
    blobs: where a sum of long waves is above a level.
    """
    place, size, kind, edge = jax.random.split(key, 4)
    rows, columns = shape
    unit = max(shape) / 2
    y = (jnp.arange(rows, dtype=float) - (rows - 1) / 2)[:, None] / unit
    x = (jnp.arange(columns, dtype=float) - (columns - 1) / 2)[None] / unit
    levels = jnp.stack([_object(place, size, y, x), _half(place, y, x), _blobs(place, y, x)])
    level = levels[jax.random.randint(kind, (), 0, 3)]
    softness = jax.random.uniform(edge, (), minval=0.4, maxval=1.5) / unit
    return jnp.clip(level / softness + 0.5, 0, 1)


def random_relief(key: PRNGKeyArray, shape: tuple[int, int]) -> Float[Array, "y x"]:
    """A smooth map from −1 to 1: slanted or curved surfaces."""
    rows, columns = shape
    y = (jnp.arange(rows, dtype=float) / rows)[:, None]
    x = (jnp.arange(columns, dtype=float) / columns)[None]
    waves = _waves(key, y, x, 1.0)
    low, high = jnp.min(waves), jnp.max(waves)
    return 2 * (waves - low) / (high - low) - 1


def _object(place, size, y, x):
    """Signed distance to a superellipse's edge, about, in half images."""
    centre = jax.random.uniform(place, (2,), minval=-0.8, maxval=0.8)
    key = jax.random.split(size, 3)
    radii = jnp.exp(jax.random.uniform(key[0], (2,), minval=math.log(0.2), maxval=math.log(0.8)))
    angle = jax.random.uniform(key[1], (), maxval=jnp.pi)
    power = jnp.where(jax.random.bernoulli(key[2]), 2.0, 10.0).astype(radii.dtype)
    down, across = y - centre[0], x - centre[1]
    u = (across * jnp.cos(angle) + down * jnp.sin(angle)) / radii[0]
    v = (down * jnp.cos(angle) - across * jnp.sin(angle)) / radii[1]
    norm = (jnp.abs(u) ** power + jnp.abs(v) ** power) ** (1 / power)
    return (1 - norm) * jnp.min(radii)


def _half(place, y, x):
    angle, offset = jax.random.uniform(place, (2,))
    turn = 2 * jnp.pi * angle
    return x * jnp.cos(turn) + y * jnp.sin(turn) - (offset - 0.5)


def _blobs(place, y, x):
    waves = _waves(place, y, x, 0.8)
    # Divided by a typical slope: about a distance.
    return (waves - jax.random.uniform(place, (), minval=-0.5, maxval=1.0)) / 5


def _waves(key, y, x, highest):
    """A sum of cosines of up to `highest` cycles per unit, of variance 1."""
    frequency, phase = jax.random.split(key)
    v, u = jax.random.uniform(frequency, (2, _WAVES, 1, 1), minval=-highest, maxval=highest)
    start = jax.random.uniform(phase, (_WAVES, 1, 1))
    waves = jnp.cos(2 * jnp.pi * (v * y + u * x + start))
    return jnp.sum(waves, axis=0) * (2 / _WAVES) ** 0.5
