"""Whether a sensor's pixels resolve what a mask casts on them."""

import math
import warnings
from collections.abc import Iterable
from typing import Any

import jax

from thincam_jax._core import checks
from thincam_jax.lensless.camera import LenslessCamera


class SamplingWarning(UserWarning):
    """The shadow of the mask is finer than what the pixels resolve."""


def unresolved(frequency: float, pitch: float) -> str:
    """Why pixels of a pitch, mm, do not resolve cycles/mm, and what does; empty where they do.

    Pixels end at their Nyquist frequency 1/(2 pitch).
    """
    nyquist = 1 / (2 * pitch)
    if frequency <= nyquist:
        return ""
    enough = math.floor(1e4 / (2 * frequency)) / 10
    return (
        f"the mask casts {frequency:.3g} cycles/mm on pixels that resolve {nyquist:.3g} "
        "(Nyquist, 1/(2 pitch)): what is finer is averaged away or aliased; give a pitch of at "
        f"most {enough:g} um, or a mask of coarser zones or cells"
    )


def warn_if_unresolved(camera: LenslessCamera, distances: Iterable[Any]) -> None:
    """SamplingWarning, at the caller's caller, for objects at these distances (mm).

    Masks that do not know their `finest_frequency`, and numbers under jit, pass.
    """
    distances = list(distances)
    known = not any(map(checks.is_traced, jax.tree.leaves((camera, distances))))
    finest = getattr(camera.mask, "finest_frequency", None) if known else None
    if finest is not None and not checks.is_traced(finest):
        farthest = max(float(distance) for distance in distances)
        magnification = 1 + float(camera.distance) / farthest
        fault = unresolved(float(finest) / magnification, float(camera.sensor.pitch))
        if fault:
            warnings.warn(fault, SamplingWarning, stacklevel=3)
