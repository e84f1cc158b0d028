"""Choices and checks before a PSF is computed: model, samples, precision, digits and memory."""

import math
import warnings
from dataclasses import replace

import jax

from thincam_jax._core import checks
from thincam_jax._core.grids import Grid
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax._core.precision import allow, cast, precision_of
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.cost import psf_cost
from thincam_jax.lensless.digits import require_digits
from thincam_jax.lensless.masks.base import AbstractFactoredMask, AbstractMask, term_count
from thincam_jax.lensless.method import SAMPLED, AccuracyWarning, PsfMethod, odd_from, psf_method
from thincam_jax.lensless.propagation.obliquity import require_off_axis
from thincam_jax.lensless.propagation.path import LightPath
from thincam_jax.lensless.propagation.radial import profile_samples
from thincam_jax.lensless.propagation.separable import pixel_nodes
from thincam_jax.lensless.propagation.skew import focuses_on_a_line
from thincam_jax.lensless.sampling import require_phase_sampling

# Part of the tolerance over a field that averages over pixels may take.
AVERAGES = 1 / 4
# Operations of samples chosen by default, some ten seconds, that are warned of.
_SLOW = 1e10
# Samples in the mean of a cell and of an edge's zone, and samples a pixel where they are not known.
_IN_CELL, _UNKNOWN_CELL = 16, 7


def resolve(
    camera: LenslessCamera, path: LightPath, method: PsfMethod
) -> tuple[AbstractMask, Grid, LightPath, PsfMethod]:
    """Mask, samples and path in the method's precision, and the method with all defaults chosen.

    Nothing is examined after it: a model takes these as they are.

    **Errors**: those of `psf`. AccuracyWarning, at the caller of the caller of `psf`, for samples
    chosen by default that are coarse or slow.
    """
    mask, grid = camera.mask, camera.sensor.grid
    tolerance = AVERAGES * (method.field_tolerance or 0.0)
    given = method
    method = psf_method(mask, grid, sampled_off_axis(mask, grid, path, method))
    require_phase_sampling(mask, grid, path, method)
    require_off_axis(mask, path, method.model)
    averaged = method.pixel_integration and method.nodes is None
    if method.model == "separable" and averaged:
        nodes = pixel_nodes(mask, grid, path, method.float_type, tolerance)
        method = replace(method, nodes=nodes)
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
            stacklevel=4,
        )
    return mask, grid, path, method


def sampled_off_axis(
    mask: AbstractMask, grid: Grid, path: LightPath, method: PsfMethod
) -> PsfMethod:
    """The method; in place of "separable" samples where a mask of edges has no closed form.

    That is of rings off the axis, of cells off both axes, whose integrals have no product, and of
    zones that focus on a line there. Samples of √(cz)/16, c a cell and z = √(λd/M) the zone of an
    edge's wave, leave about 1 %.
    """
    if method.model != "separable" or path.at is None:
        return method
    cells = isinstance(mask, AbstractFactoredMask) and not term_count(mask).chirped
    beyond = path.skew and (cells or focuses_on_a_line(mask, path))
    if not (beyond or mask.exact_model == "radial"):
        return method
    samples = _UNKNOWN_CELL
    if not checks.holds_traced(mask, grid, replace(path, at=None)):
        with jax.ensure_compile_time_eval():  # they are known under jit, too
            zone = math.sqrt(path.wavelength * path.distance / path.magnification)
            finest = mask.finest_frequency
            cell = zone if finest is None else 0.5 / float(finest)
            samples = odd_from(_IN_CELL * float(grid.pitch) / math.sqrt(cell * zone))
    return replace(method, model="angular_spectrum", nodes=None, oversampling=samples)
