"""Bringing captures at different mask-sensor distances to one scale."""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax.lensless.camera import LenslessCamera


def registered_shape(shape: tuple[int, int], ratio: float) -> tuple[int, int]:
    """Pixels of a capture enlarged by `ratio` ≥ 1: enough for it, of the same parity."""
    rows, columns = (n + 2 * math.ceil((n * ratio - n) / 2 - 1e-6) for n in shape)
    return rows, columns


def register(image: Float[Array, "*batch y x"], ratio: float) -> Float[Array, "*batch v u"]:
    """A capture enlarged about its centre by `ratio` = d_ref/d ≥ 1; the pitch stays.

    A scene point's shadow moves by d/t: a capture at d is, enlarged, on the scale of one at d_ref.
    Lanczos interpolation (``jax.image.scale_and_translate``); outside the sensor it is zero.
    """
    if ratio < 1:
        raise ValueError(f"ratio = {ratio:g}: captures are enlarged, give a ratio of at least 1")
    if ratio == 1:
        return image
    rows, columns = image.shape[-2:]
    shape = registered_shape((rows, columns), ratio)
    scale = jnp.full(2, ratio, dtype=image.dtype)
    offsets = [(m - n * ratio) / 2 for m, n in zip(shape, image.shape[-2:], strict=True)]
    enlarged = jax.image.scale_and_translate(
        image,
        (*image.shape[:-2], *shape),
        (image.ndim - 2, image.ndim - 1),
        scale,
        jnp.asarray(np.array(offsets), dtype=image.dtype),
        method="lanczos5",
        antialias=False,
    )
    return enlarged


def distance_ratios(cameras: Sequence[LenslessCamera]) -> list[float]:
    """How much each camera's captures are enlarged: largest distance over its own."""
    if any(checks.is_traced(c.distance) for c in cameras):
        raise TypeError(
            "the cameras' distances are traced, but set array sizes: give them as known numbers"
        )
    distances = [float(c.distance) for c in cameras]
    return [max(distances) / d for d in distances]


def own_field(field_shape: tuple[int, int], ratio: float) -> tuple[int, int]:
    """The field in samples of a camera's own scale, ratio times coarser; parity as the field's."""
    rows, columns = (n - 2 * math.floor((n - n / ratio) / 2 + 1e-6) for n in field_shape)
    return rows, columns
