"""Whether pixels resolve what a mask casts on them, and samples the phases of a mask."""

import math
import warnings
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np

from thincam_jax._core import checks
from thincam_jax._core.grids import Grid
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.masks.phase import PhaseMask
from thincam_jax.lensless.method import Model, PsfMethod, odd_from
from thincam_jax.lensless.propagation.path import LightPath


class SamplingWarning(UserWarning):
    """The shadow of the mask is finer than what the pixels resolve.

    ```python
    import warnings

    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(100.0, width=1.6)  # zones finer than the pixels
    with warnings.catch_warnings(action="ignore", category=tc.lensless.sampling.SamplingWarning):
        camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
        h = tc.psf(camera, wavelength=500 * nm)
    ```

    **See also**: `psf`.
    """


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
    known = not checks.holds_traced(camera, distances)
    finest = camera.mask.finest_frequency if known else None
    if finest is not None and not checks.is_traced(finest):
        farthest = max(float(distance) for distance in distances)
        magnification = 1 + float(camera.distance) / farthest
        fault = unresolved(float(finest) / magnification, float(camera.sensor.pitch))
        if fault:
            warnings.warn(fault, SamplingWarning, stacklevel=3)


def require_phase_sampling(
    mask: AbstractMask, grid: Grid, path: LightPath, method: PsfMethod
) -> None:
    r"""ValueError where samples do not hold the phases of a `PhaseMask`, with what does.

    The light just behind the mask has the local frequency ν = |∂φ/∂x|/2π + ν_lit along an axis;
    between samples Δ apart its phase turns by 2πΔν, which must stay below π. ν_lit is that of the
    spherical wave at the mask's rim, r/(λ√(t² + r²)); the summand of `rayleigh_sommerfeld` has the
    waves to the farthest pixel in it too, ρ/(λ√(d² + ρ²)). Cells need samples no larger than they.

    Light steeper than the window's band limit is left out; with the padding of
    `angular_spectrum` it misses the sensor. Wavelengths outside the material's band are refused,
    too. Masks of other kinds and traced numbers pass.
    """
    known = not checks.holds_traced(mask, grid, path)
    if not isinstance(mask, PhaseMask) or method.oversampling is None or not known:
        return
    wavelength = float(path.wavelength)
    low, high = mask.material.band
    if not low <= wavelength <= high:
        raise ValueError(
            f"wavelength = {wavelength:g} mm is outside of the material's band; give {low:g} to "
            f"{high:g} mm"
        )
    with jax.ensure_compile_time_eval():  # they are known under jit, too
        own, highest = _frequencies(mask, grid, path, method.model)
    pitch = float(grid.pitch)
    enough = odd_from(2 * pitch * highest)
    if method.samples >= enough:
        return
    samples = f"samples {pitch / method.samples * 1e3:.3g} um apart"
    if mask.interpolation == "cells" and own == highest:
        fault = f"the mask's cells of {float(mask.pitch) * 1e3:.3g} um are finer than {samples}"
    else:
        turned = 2 * pitch / method.samples * highest
        fault = (
            f"behind the mask the phase turns by up to {turned:.2g} π between {samples} "
            f"({highest:.3g} cycles/mm), which hold less than π"
        )
    raise ValueError(
        f"{fault}: give oversampling = {enough} or more, or a mask of coarser cells or gentler "
        "slopes"
    )


def samples_needed(mask: AbstractMask, grid: Grid, path: LightPath, model: Model) -> int:
    """Samples a pixel, odd, that hold the phases of a `PhaseMask`; 1 of other masks."""
    if not isinstance(mask, PhaseMask):
        return 1
    return odd_from(2 * float(grid.pitch) * _frequencies(mask, grid, path, model)[1])


def _frequencies(mask: PhaseMask, grid: Grid, path: LightPath, model: Model) -> tuple[float, float]:
    """The highest local frequency that the relief makes, and that of the light, cycles/mm."""
    wavelength, distance, away = (
        float(n) for n in (path.wavelength, path.distance, path.object_distance)
    )
    rims = np.abs(np.asarray(mask.centre)) + np.asarray([float(side) for side in mask.extent]) / 2
    rim = float(rims.max())
    lit = rim / math.hypot(away, rim) / wavelength if math.isfinite(away) else 0.0
    if model == "rayleigh_sommerfeld":
        reach = float(np.max(rims + np.asarray(grid.shape) * float(grid.pitch) / 2))
        lit += reach / math.hypot(distance, reach) / wavelength
    own = float(mask.steepest_frequency(wavelength))
    return own, max(own, lit) if mask.interpolation == "cells" else own + lit
