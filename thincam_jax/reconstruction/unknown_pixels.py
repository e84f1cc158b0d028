"""Pixels of captures that measure no light: masked, NaN, saturated or defective."""

import logging
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float

from thincam_jax._core import checks
from thincam_jax.imaging.defects import defects, plateau


def without_unknown(capture: Any) -> tuple[Any, np.ndarray | None]:
    """A capture with 0 for what is masked or NaN, and where it is known; None: everywhere."""
    try:
        array = None if checks.holds_traced(capture) else checks.native(capture)
    except (TypeError, ValueError, RecursionError):  # refused by `as_real`, in words
        return capture, None
    if array is None or array.dtype.kind != "f" or not (unknown := np.isnan(array)).any():
        return capture, None
    return np.where(unknown, np.zeros((), array.dtype), array), ~unknown


def valid_pixels(
    captures: Sequence[Float[Array, "..."]],
    known: Sequence[np.ndarray | None],
    valid: Sequence[Any] | None,
    is_examined: bool,
) -> tuple[Bool[Array, "..."], ...] | None:
    """Masks of pixels that are known and valid; None: everywhere.

    How many are masked or NaN is logged as a warning. If `is_examined`, so are those that are
    saturated, on a plateau at the largest value of an image, and those that most captures find hot
    or dead.
    """
    masks: list[Any] = list(valid or [np.True_] * len(captures))
    good = [
        np.broadcast_to(True if k is None else k, c.shape)
        for k, c in zip(known, captures, strict=True)
    ]
    _exclude(masks, good, "masked or NaN")
    if is_examined and not checks.holds_traced(captures):
        images = [np.asarray(capture) for capture in captures]
        odd = [_each(image.astype(np.float32), defects) for image in images]
        alike = [[other for other in odd if other.shape == one.shape] for one in odd]
        odd = [one & (2 * np.sum(s, axis=0) > len(s)) for one, s in zip(odd, alike, strict=True)]
        _exclude(masks, [~one for one in odd], "hot or dead")
        dim = [np.where(o, c.min(), c) for c, o in zip(images, odd, strict=True)]
        full = [_each(image, _saturated) for image in dim]
        _exclude(masks, [~one for one in full], "saturated, at one largest value")
    if all(mask is np.True_ for mask in masks):
        return None
    return tuple(
        mask if checks.is_traced(mask) else checks.as_array(np.broadcast_to(mask, capture.shape))
        for mask, capture in zip(masks, captures, strict=True)
    )


def _exclude(masks: list[Any], good: Sequence[np.ndarray], why: str) -> None:
    """Exclude from masks what is not `good`; how many pixels that are is logged."""
    lost = 0
    for number, (mask, one) in enumerate(zip(masks, good, strict=True)):
        if one.all():
            continue
        masks[number] = mask & one
        lost += 0 if checks.is_traced(mask) else int(np.count_nonzero(np.asarray(mask) & ~one))
    if lost:
        logging.getLogger(__name__).warning("%d pixels are %s: they are not valid", lost, why)


def _each(image: np.ndarray, find: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    planes = image.reshape(-1, *image.shape[-2:])
    return np.stack([find(plane) for plane in planes]).reshape(image.shape)


def _saturated(plane: np.ndarray) -> np.ndarray:
    return (plane == plane.max()) & bool(plateau(plane))
