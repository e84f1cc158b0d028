r"""Cost of an evaluation before it is done: arithmetic and peak memory.

The laws follow the arrays that each model forms; their constants are measured once, from the
buffers that XLA allocates on a CPU (``compiled.memory_analysis()``) and from timings.
"""

import math
from dataclasses import dataclass

from thincam_jax._core.grids import Grid, fast_shape
from thincam_jax._core.precision import itemsize_of
from thincam_jax.lensless.masks.base import AbstractFactoredMask, AbstractMask, term_count
from thincam_jax.lensless.masks.pinhole import RadialMask
from thincam_jax.lensless.method import PIXEL_NODES, SAMPLED, PsfMethod, has_few_terms
from thincam_jax.lensless.propagation.angular_spectrum import padded_shape
from thincam_jax.lensless.propagation.radial import profile_length

# Real operations of one chirp integral (both edges in both their forms, with their phasors), of the
# wave of one edge, of one phasor, of one sample of a propagated field besides its transforms, of
# one summand of the Rayleigh-Sommerfeld integral, and of the field of one disc.
_CHIRP, _EDGE, _PHASOR, _WAVE, _SUMMAND, _DISC = 1200, 250, 40, 100, 60, 1500
# What any evaluation holds beside its arrays: its arguments and constants.
_BASE = 4096
# Samples of the sensor that the direct sum does at a time.
_BATCH = 64


@dataclass(frozen=True)
class Cost:
    """The cost of one evaluation.

    - `flops`: real operations, transcendental functions counted as the operations they take.
    - `bytes`: peak memory, result included.
    """

    flops: float
    bytes: int

    def times(self, count: int) -> "Cost":
        """Cost of `count` evaluations, one after another."""
        return Cost(self.flops * count, self.bytes)


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


def convolution_cost(
    sensor_shape: tuple[int, int], field_shape: tuple[int, int], images: int, itemsize: int
) -> Cost:
    """Cost of one crop-convolution of `images` fields with a PSF that is given."""
    kernel = tuple(s + f - 1 for s, f in zip(sensor_shape, field_shape, strict=True))
    window = math.prod(fast_shape((kernel[0], kernel[1]), real=True))
    transforms = 2 * images + 1
    flops = transforms * 2.5 * window * math.log2(window + 1) + 6 * images * window
    return Cost(flops, int(itemsize * window * (3 * images + 4)))
