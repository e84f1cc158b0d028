"""Pixels of captures that are masked or NaN, which are not valid."""

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, Bool

from thincam_jax._core import checks


def without_unknown(capture: Any) -> tuple[Any, np.ndarray | None]:
    """A capture with 0 for what is masked or NaN, and where it is known; None: everywhere."""
    try:
        array = None if checks.holds_traced(capture) else checks.native(capture)
    except (TypeError, ValueError, RecursionError):  # refused by `as_real`, in words
        return capture, None
    if array is None or array.dtype.kind != "f" or not (unknown := np.isnan(array)).any():
        return capture, None
    return np.where(unknown, np.zeros((), array.dtype), array), ~unknown


def known_and_valid(
    known: Sequence[np.ndarray | None], valid: Sequence[Any] | None, shapes: Sequence[Any]
) -> tuple[Bool[Array, "..."], ...]:
    """Masks of pixels that are known and valid; how many are lost is logged as a warning."""
    found, lost = [], 0
    for one, mask, shape in zip(known, valid or [np.True_] * len(known), shapes, strict=True):
        one = np.broadcast_to(True if one is None else one, shape)
        if checks.is_traced(mask):
            found.append(mask & one)
            continue
        found.append(checks.as_array(np.asarray(mask) & one))
        lost += int(np.count_nonzero(np.asarray(mask) & ~one))
    if lost:
        logging.getLogger(__name__).warning("%d pixels are masked or NaN: they are not valid", lost)
    return tuple(found)
