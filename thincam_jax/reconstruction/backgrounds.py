"""Uniform backgrounds of captures: what captures and operators tell of them."""

import copy
from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from thincam_jax._core.grids import block_sum
from thincam_jax._core.quick_programs import quickly_compiled
from thincam_jax.imaging.operators import AbstractOperator
from thincam_jax.reconstruction.problem import (
    UNEVEN,
    Background,
    InverseProblem,
    forward,
    or_one,
    weighted_mean,
)

# Side of the blocks of pixels of which the darkest limits a background, and its standard errors.
_BLOCK, _ERRORS = 8, 4


@quickly_compiled
def darkest(
    captures: Sequence[Float[Array, "..."]], weights: Sequence[Float[Array, "..."]]
) -> tuple[Float[Array, "..."], ...]:
    """Highest background of each capture: the mean of its darkest block, and four errors of it."""

    def of(capture, weight):
        whole = jnp.broadcast_to(weight, jnp.broadcast_shapes(weight.shape, capture.shape))
        capture = jnp.where(whole > 0, capture, 0)
        inner = tuple(slice(n - n % _BLOCK) for n in capture.shape[-2:])
        sums = (block_sum((whole * capture**n)[..., *inner], _BLOCK) for n in range(3))
        count, light, squares = sums
        mean = light / or_one(count)
        variance = jnp.maximum(squares / or_one(count) - mean**2, 0) / or_one(count)
        limits = jnp.where(count > _BLOCK**2 / 2, mean + _ERRORS * jnp.sqrt(variance), jnp.inf)
        return jnp.min(limits, axis=(-2, -1), keepdims=True)

    return tuple(map(of, captures, weights))


@quickly_compiled
def shows_brightness(
    operators: Sequence[AbstractOperator], uniform: Float[Array, "1 1 1 1"]
) -> list[Bool[Array, ""]]:
    """Whether the capture of a `uniform` image is not uniform, of each operator."""
    return [_is_uneven(forward(operator, uniform)) for operator in operators]


def _is_uneven(flat: Float[Array, "..."]) -> Bool[Array, ""]:
    return jnp.var(flat) > UNEVEN * jnp.mean(flat**2)


@quickly_compiled
def light_of_uniform(
    operators: Sequence[AbstractOperator],
    captures: Sequence[Float[Array, "*batch y x"]],
    weights: Sequence[Float[Array, "..."] | Bool[Array, "..."]],
) -> list[Float[Array, ""]]:
    """Correlation of each capture with that of a uniform image, both without their means.

    It is 0 where a uniform image casts a uniform capture.
    """
    found = []
    for operator, capture, weight in zip(operators, captures, weights, strict=True):
        weight = jnp.broadcast_to(weight, capture.shape).astype(capture.dtype)
        flat = forward(operator, jnp.ones((1,) * 4, capture.dtype))
        shown = _is_uneven(flat)
        colours = (n for n in flat.shape[:-2] if n > 1)
        flat = jnp.broadcast_to(flat.reshape(*colours, *flat.shape[-2:]), capture.shape)
        flat, light = (one - weighted_mean(weight, one, 2) for one in (flat, capture))
        size = jnp.sum(weight * flat**2) * jnp.sum(weight * light**2)
        both = jnp.sum(weight * flat * light) / jnp.sqrt(or_one(size))
        found.append(jnp.where(shown, both, 0))
    return found


def with_other_background(problem: InverseProblem, background: Background) -> InverseProblem:
    """This problem with another kind of background."""
    other = copy.copy(problem)
    object.__setattr__(other, "background", background)  # of the copy: a static field is no leaf
    return other
