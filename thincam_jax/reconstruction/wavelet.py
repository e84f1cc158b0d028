r"""Orthonormal wavelets of images of any size: Haar and Daubechies.

A line x of even length n is split in two halves by a filter h and its mirror,

.. math:: a_k = \sum_m h_m x_{(2k + m) \bmod n},\qquad
    d_k = \sum_m (-1)^m h_{M-1-m} x_{(2k + m) \bmod n},

an orthonormal map, periodic at the border (Daubechies, Commun. Pure Appl. Math. 41, 909, 1988).
The last sample of a line of odd length joins the coarse half as it is, so that the map of the
whole line is orthonormal for every length. Lines and columns are split in turn; then the
coarse quarter again.
"""

import functools
import math
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks

Family = Literal["haar", "daubechies4", "daubechies8"]

_ROOT3 = math.sqrt(3.0)
# Scaling filters: the number is their length; vanishing moments are half as many.
FILTERS: dict[str, tuple[float, ...]] = {
    "haar": (math.sqrt(0.5), math.sqrt(0.5)),
    "daubechies4": tuple(
        c / (4 * math.sqrt(2.0)) for c in (1 + _ROOT3, 3 + _ROOT3, 3 - _ROOT3, 1 - _ROOT3)
    ),
    "daubechies8": (
        0.23037781330885523,
        0.7148465705525415,
        0.6308807679295904,
        -0.02798376941698385,
        -0.18703481171888114,
        0.030841381835986965,
        0.032883011666982945,
        -0.010597401784997278,
    ),
}


class Wavelet(eqx.Module):
    """An orthonormal wavelet transform over the last two axes.

    The coefficients have the shape of the image: coarse ones in the upper left corner, as large as
    `coarse_shape` says.

    - `family`: "haar", for edges along the axes; "daubechies4" and "daubechies8", for smoother
      images.
    - `levels`: how often the coarse part is split; splitting ends where one sample is left.
    """

    family: Family = eqx.field(static=True)
    levels: int = eqx.field(static=True)

    def __init__(self, family: Family = "daubechies4", levels: int = 4):
        self.family = checks.choice("family", family, tuple(FILTERS))  # type: ignore[assignment]
        if levels < 1:
            raise ValueError(f"levels = {levels}: give at least 1")
        self.levels = levels

    def analyse(self, image: Float[Array, "*batch y x"]) -> Float[Array, "*batch y x"]:
        """The coefficients of an image."""
        return _analyse(image, self.family, self._shapes(_size(image)))

    def synthesise(self, coefficients: Float[Array, "*batch y x"]) -> Float[Array, "*batch y x"]:
        """The image of coefficients: the transpose and inverse of `analyse`."""
        return _synthesise(coefficients, self.family, self._shapes(_size(coefficients)))

    def coarse_shape(self, shape: tuple[int, int]) -> tuple[int, int]:
        """Size of the coarse part that is left in the end."""
        return _half(self._shapes(shape)[-1])

    def _shapes(self, shape: tuple[int, int]) -> tuple[tuple[int, int], ...]:
        """Sizes of the coarse part before each split."""
        shapes = [shape]
        for _ in range(self.levels - 1):
            shapes.append(_half(shapes[-1]))
        return tuple(shapes)


@functools.partial(jax.jit, static_argnames=("family", "shapes"))
def _analyse(image, family: str, shapes):
    result = image
    for rows, columns in shapes:
        coarse = _split(_split(result[..., :rows, :columns], family, -2), family, -1)
        result = result.at[..., :rows, :columns].set(coarse)
    return result


@functools.partial(jax.jit, static_argnames=("family", "shapes"))
def _synthesise(coefficients, family: str, shapes):
    result = coefficients
    for rows, columns in reversed(shapes):
        fine = _join(_join(result[..., :rows, :columns], family, -1), family, -2)
        result = result.at[..., :rows, :columns].set(fine)
    return result


def _size(image: Array) -> tuple[int, int]:
    rows, columns = image.shape[-2:]
    return rows, columns


def _half(shape: tuple[int, int]) -> tuple[int, int]:
    rows, columns = shape
    return (rows + 1) // 2, (columns + 1) // 2


def _split(line: Float[Array, "..."], family: str, axis: int) -> Float[Array, "..."]:
    """Coarse and detail halves of the lines along an axis, one behind the other."""
    line = jnp.moveaxis(line, axis, -1)
    even = line.shape[-1] // 2 * 2
    body, rest = line[..., :even], line[..., even:]
    coarse = detail = jnp.zeros_like(body[..., ::2])
    for m, (low, high) in enumerate(_filters(family)):
        taken = jnp.roll(body, -m, axis=-1)[..., ::2]
        coarse, detail = coarse + low * taken, detail + high * taken
    return jnp.moveaxis(jnp.concatenate([coarse, rest, detail], axis=-1), -1, axis)


def _join(line: Float[Array, "..."], family: str, axis: int) -> Float[Array, "..."]:
    """The transpose of `_split`."""
    line = jnp.moveaxis(line, axis, -1)
    half = line.shape[-1] // 2
    coarse, rest, detail = jnp.split(line, [half, line.shape[-1] - half], axis=-1)
    body = jnp.zeros((*line.shape[:-1], 2 * half), line.dtype)
    for m, (low, high) in enumerate(_filters(family)):
        spread = jnp.zeros_like(body).at[..., ::2].set(low * coarse + high * detail)
        body = body + jnp.roll(spread, m, axis=-1)
    return jnp.moveaxis(jnp.concatenate([body, rest], axis=-1), -1, axis)


def _filters(family: str) -> list[tuple[float, float]]:
    low = np.array(FILTERS[family])
    high = low[::-1] * (-1.0) ** np.arange(len(low))
    return list(zip(low.tolist(), high.tolist(), strict=True))
