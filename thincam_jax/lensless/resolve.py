"""Choices and checks before a PSF is computed: model, samples, precision, digits and memory.

The laws follow the arrays that each model forms; their constants are measured once, from the
buffers that XLA allocates on a CPU (``compiled.memory_analysis()``) and from timings.
"""

import math
import warnings
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.grids import Grid
from thincam_jax._core.memory import Cost, refuse_if_too_large
from thincam_jax._core.precision import allow, cast, itemsize_of, precision_of
from thincam_jax.lensless.camera import ERROR_PER_RADIAN, LenslessCamera, LightPath
from thincam_jax.lensless.masks.base import (
    AbstractFactoredMask,
    AbstractMask,
    has_few_terms,
    other_models,
    term_count,
)
from thincam_jax.lensless.masks.openings import RadialMask
from thincam_jax.lensless.masks.phase import PhaseMask
from thincam_jax.lensless.method import (
    PIXEL_NODES,
    SAMPLED,
    AccuracyWarning,
    Model,
    PsfMethod,
    as_method,
    odd_from,
    psf_method,
    sampled_off_axis,
    with_nodes,
)
from thincam_jax.lensless.propagation.angular_spectrum import padded_shape
from thincam_jax.lensless.propagation.radial import profile_length, profile_samples


class SamplingWarning(UserWarning):
    """The shadow of the mask is finer than what the pixels resolve.

    ```python
    import warnings

    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(100.0, width=1.6)  # zones finer than the pixels
    with warnings.catch_warnings(action="ignore", category=tc.lensless.resolve.SamplingWarning):
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
    enough = math.floor(1e4 / (2 * frequency)) / 10 or 500 / frequency
    return (
        f"the mask casts {frequency:.3g} cycles/mm on pixels that resolve {nyquist:.3g} "
        "(Nyquist, 1/(2 pitch)): what is finer is averaged away or aliased; give a pitch of at "
        f"most {enough:.3g} um, or a mask of coarser zones or cells"
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


# Error of waves of third order, relative, that is warned of.
_MOST_LEFT_OUT = 0.05


def require_off_axis(mask: AbstractMask, path: LightPath, model: Model) -> None:
    """ValueError for a model on the axis only; AccuracyWarning where the ray is too steep for it.

    Known numbers only: of traced ones, the model alone is looked at.
    """
    if (path.at is None and path.place is None) or model in (*SAMPLED, "geometric"):
        return
    if path.at is None and model in ("separable", "radial"):  # the waves of the axis, moved
        return
    if model != "separable":
        raise ValueError(
            f"model {model!r} is for points on the axis: leave `at` out, or use "
            + (other_models(mask) if model != "radial" else "'angular_spectrum'")
        )
    if checks.holds_traced(mask, path):
        return
    with jax.ensure_compile_time_eval():
        finest = mask.finest_frequency
        if finest is None:
            return
        ray = path.chief_ray(mask.centre)
        assert ray is not None
        cosine, distance = float(ray.cosine), float(path.distance / path.magnification)
    phase = third_order(float(path.wavelength), distance, float(np.asarray(finest)), cosine)
    if ERROR_PER_RADIAN * phase > _MOST_LEFT_OUT:
        angle = math.degrees(math.acos(cosine))
        warnings.warn(
            f"at {angle:.0f}° waves of third order about the ray, which 'separable' leaves out, "
            f"turn by up to {phase:.2g} rad; 'angular_spectrum' has them",
            AccuracyWarning,
            stacklevel=5,
        )


def third_order(wavelength: float, distance: float, frequency: float, cosine: float) -> float:
    r"""Phase of third order about the chief ray, rad, at a frequency ν of the mask's light.

    :math:`\tfrac{\pi}{\lambda D^2}\,s\,c^2 u^3` with D = d/c at u = λDν/c², where that light
    meets the plane of incidence: :math:`\pi s \lambda^2 d \nu^3 / c^5`.
    """
    sine = math.sqrt(1 - cosine**2)
    return math.pi * sine * wavelength**2 * distance * frequency**3 / cosine**5


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


# Fringes whose phase is known to a twentieth of a radian are wrong by some per cent.
_LARGEST = 0.05 * 2.0**24


def require_digits(mask: AbstractMask, grid: Grid, path: LightPath, model: str) -> None:
    r"""ValueError where float32 cannot represent the phase of the zones on the sensor.

    The fringes of the order k have the phase :math:`k\beta r^2/(M^2(1+k\epsilon))` at r on the
    sensor, :math:`k\beta(1-k\epsilon) r^2/M^2` of "paraxial", which float32 rounds by 2⁻²⁴ of
    itself. More than 0.05 rad is refused: the PSF would be
    wrong by several per cent. Traced numbers are not checked.
    """
    if not held_in_single(mask, grid, path, model):
        phase = largest_phase(mask, grid, path, model)
        raise ValueError(
            f"float32 holds the zones' phase of {phase:.1e} rad on this sensor only to "
            f"{phase * 2.0**-24:.1g} rad; give PsfMethod({model!r}, precision='float64')"
        )


def held_in_single(mask: AbstractMask, grid: Grid, path: LightPath, model: str) -> bool:
    """Whether float32 can represent the zones' phases; True for traced numbers."""
    numbers = jax.tree.leaves((mask, grid, path))
    if not hasattr(mask, "zone_orders") or any(checks.is_traced(n) for n in numbers):
        return True
    return largest_phase(mask, grid, path, model) <= _LARGEST


def largest_phase(mask: Any, grid: Grid, path: LightPath, model: str) -> float:
    """Largest phase, rad, of the orders' fringes where they are strong and light falls."""
    beta, halves, orders = float(mask.beta), [float(n) / 2 for n in mask.extent], mask.orders
    with jax.ensure_compile_time_eval():  # inside jit, sums of known numbers are traced as well
        scale, epsilon = map(float, _scale_and_epsilon(path, mask.beta))
    epsilon = 0.0 if model == "geometric" else epsilon
    ends = [
        (n - 1) / 2 * float(grid.pitch) / scale + abs(float(c))
        for n, c in zip(grid.shape, np.asarray(mask.centre), strict=True)
    ]
    found = 0.0
    for k in orders:
        if model == "paraxial":  # its phases are those of kβ(1 − kε), which grow with k²ε
            found = max(found, abs(k) * beta * abs(1 - k * epsilon) * sum(r**2 for r in ends))
        gain = abs(1 + k * epsilon)
        if k == 0 or gain == 0 or gain > 2:  # beyond, the order is spread out and weak
            continue
        # A bounded order is seen where its image is: the aperture, shrunk or grown by its focus.
        gain_of_reach = math.inf if model in ("paraxial", "closed_form") else gain
        reach = (min(end, gain_of_reach * half) for end, half in zip(ends, halves, strict=True))
        found = max(found, abs(k) * beta / gain * sum(r**2 for r in reach))
    return found


@jax.jit
def _scale_and_epsilon(path: LightPath, beta: Float[Array, ""]):
    return path.magnification, path.epsilon(beta)


# Real operations of one chirp integral (both edges in both their forms, with their phasors), of the
# wave of one edge, of one phasor, of one sample of a propagated field besides its transforms, of
# one summand of the Rayleigh-Sommerfeld integral, and of the field of one disc.
_CHIRP, _EDGE, _PHASOR, _WAVE, _SUMMAND, _DISC = 1200, 250, 40, 100, 60, 1500
# What any evaluation holds beside its arrays: its arguments and constants.
_BASE = 4096
# Samples of the sensor that the direct sum does at a time.
_BATCH = 64


def psf_cost(mask: AbstractMask, grid: Grid, method: PsfMethod) -> Cost:
    """Cost of `psf` on a grid."""
    rows, columns = grid.shape
    itemsize = itemsize_of(method.float_type)
    if method.model in SAMPLED:
        flops, numbers = _sampled(grid.shape, method)
    elif isinstance(mask, RadialMask) and method.model == "radial":
        flops, numbers = _radial(mask, grid.shape, method)
    else:
        flops, numbers = _separable_sum(mask, grid.shape, method)
    return Cost(float(flops), _BASE + itemsize * (int(numbers) + rows * columns))


def _sampled(shape: tuple[int, int], method: PsfMethod) -> tuple[float, float]:
    """Operations and real numbers held by the models that sample the mask."""
    fine = [n * method.samples for n in shape]
    plane = [n * method.samples for n in (method.mask_shape or shape)]
    if method.model == "angular_spectrum":
        window = math.prod(padded_shape((plane[0], plane[1]), (fine[0], fine[1]), 2.0))
        return window * (_WAVE + 10.0 * math.log2(window)), 5.0 * window
    points = math.prod(fine if method.pixel_integration else shape)
    held = math.prod(plane) * (2.1 * min(_BATCH, points) + 3) * 2
    return float(_SUMMAND * math.prod(plane) * points), held


def _radial(mask: RadialMask, shape: tuple[int, int], method: PsfMethod) -> tuple[float, float]:
    """Operations and numbers held for the discs' fields at a profile's or all pixels' samples."""
    pixels, points = math.prod(shape), (method.nodes or 1) if method.pixel_integration else 1
    at_once = profile_length(shape, method.oversampling) if method.oversampling else pixels
    discs = at_once * (1 if method.oversampling else points)
    return float(_DISC * mask.rings.size * discs + _EDGE * pixels * points), 30.0 * at_once


def _separable_sum(mask, shape: tuple[int, int], method: PsfMethod) -> tuple[float, float]:
    """Operations and numbers held by models that are a short sum of separable terms."""
    if not isinstance(mask, AbstractFactoredMask):  # a geometric shadow, sampled
        return 4.0 * math.prod(shape), 2.0 * math.prod(shape)
    length = sum(shape)
    known = term_count(mask)
    count, cells, chirped = known.terms, known.cells, known.chirped
    pairs = count * (count + 1) // 2
    if method.model == "separable":
        nodes = (method.nodes or PIXEL_NODES) if method.pixel_integration else 1
        if not has_few_terms(mask):
            across = cells * count * max(shape) * (not chirped)  # the mask's cells, once a node
            edges = (_CHIRP * count if chirped else _EDGE) * length * cells
            flops = nodes * (6.0 * (count * math.prod(shape) + across) + edges)
            return flops, 8.0 * (count + cells) * length + 6.0 * math.prod(shape)
        at_once = length * (count * cells if chirped else cells + 1)
        flops = nodes * (_CHIRP if chirped else _EDGE) * at_once
        flops += nodes * 16 * count * cells * length * (not chirped)
        # One node after another; the orders' fields of all of them.
        fields = nodes * count * length if method.pixel_integration else 0
        held = max(5.5 * at_once + 2.5 * fields, 5.2 * pairs * length)
        terms = pairs
    else:
        terms = pairs - count + 1 if method.model != "geometric" else known.shadow
        work = _CHIRP if method.pixel_integration else _PHASOR
        flops = work * terms * length * cells
        per_factor = 12.0 if method.pixel_integration else 2.1
        held = per_factor * terms * length + (2.5 * cells * length if cells > 1 else 0)
    return float(flops + 4 * terms * math.prod(shape)), float(held)


# Operations of samples chosen by default, some ten seconds, that are warned of.
_SLOW = 1e10


def resolve(
    mask: AbstractMask,
    grid: Grid,
    path: LightPath,
    model: Model | PsfMethod,
    pixel_integration: bool = True,
) -> tuple[AbstractMask, Grid, LightPath, PsfMethod]:
    """Mask, samples and path in the chosen precision, and the model with all settings chosen.

    Nothing is examined after it: a model takes these as they are.

    **Errors**: those of `psf`. AccuracyWarning, at the caller of the caller of `psf`, for samples
    chosen by default that are coarse or slow.
    """
    given = method = as_method(model, pixel_integration)
    mask = mask.without_dark_margins()
    method = psf_method(mask, grid, sampled_off_axis(mask, grid, path, method))
    method = with_nodes(method, mask, grid, path)
    require_phase_sampling(mask, grid, path, method)
    require_off_axis(mask, path, method.model)
    if method.model == "radial" and method.oversampling is None:
        method = replace(method, oversampling=profile_samples(mask, grid, path, method))
    with allow(method.float_type, mask, grid, path):
        if method.precision != precision_of(grid.pitch):
            mask, grid, path = cast((mask, grid, path), method.float_type)
        if method.precision == "float32":
            require_digits(mask, grid, path, method.model)
    (rows, columns), cost = grid.shape, psf_cost(mask, grid, method)
    refuse_if_too_large(
        f"a PSF of {rows}×{columns} pixels by model {method.model!r}",
        cost.bytes,
        "use a smaller grid"
        if method.model not in SAMPLED
        else "use a smaller grid or less oversampling",
    )
    if given.model != method.model == "angular_spectrum" and cost.flops > _SLOW:
        few = odd_from(method.samples / 3)
        warnings.warn(
            f"off the axis {method.samples}×{method.samples} samples a pixel hold this "
            f"{type(mask).__name__}, some {10 * cost.flops / _SLOW:.0f} s of a core; "
            f"PsfMethod('angular_spectrum', oversampling={few}) takes a tenth, and is coarser",
            AccuracyWarning,
            stacklevel=5,
        )
    return mask, grid, path, method
