"""Pixels of captures that are masked or NaN, which are not valid."""

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, Bool

from thincam_jax._core import checks


def without_unknown(captures: Any) -> tuple[list[Any], list[np.ndarray | None]]:
    """Captures with 0 for what is masked or NaN, and where each is known; None: everywhere."""
    pairs = [_without_unknown(capture) for capture in captures]
    return [capture for capture, _ in pairs], [known for _, known in pairs]


def _without_unknown(capture: Any) -> tuple[Any, np.ndarray | None]:
    if checks.holds_traced(capture):
        return capture, None
    try:
        array = checks.native(capture)
    except (TypeError, ValueError, RecursionError):  # refused by `as_real`, in words
        return capture, None
    unknown = np.isnan(array) if array.dtype.kind == "f" else np.zeros((), bool)
    if not unknown.any():
        return capture, None
    return np.where(unknown, np.zeros((), array.dtype), array), ~unknown


def known_and_valid(
    known: Sequence[np.ndarray | None], valid: Sequence[Any] | None, shapes: Sequence[Any]
) -> tuple[Bool[Array, "..."], ...]:
    """Masks of pixels that are known and valid; how many are lost is logged as a warning."""
    given = [np.True_] * len(known) if valid is None else valid
    found, lost = [], 0
    for one, mask, shape in zip(known, given, shapes, strict=True):
        if one is None or checks.is_traced(mask):
            found.append(mask if one is None else mask & one)
        else:
            found.append(np.asarray(mask) & one)
            lost += int(np.count_nonzero(np.asarray(mask) & ~one))
        if not checks.is_traced(found[-1]):
            found[-1] = checks.as_array(np.broadcast_to(np.asarray(found[-1], bool), shape))
    if lost:
        logging.getLogger(__name__).warning("%d pixels are masked or NaN: they are not valid", lost)
    return tuple(found)
