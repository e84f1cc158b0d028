"""The models of the PSF by name, and how one is computed."""

import math
import warnings
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Literal, get_args

import jax
import numpy as np

from thincam_jax._core import checks
from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import PRECISIONS, AccuracyWarning, Precision, precision_of
from thincam_jax.lensless.camera import LightPath
from thincam_jax.lensless.masks.base import (
    AbstractFactoredMask,
    AbstractMask,
    has_few_terms,
    other_models,
    term_count,
    zone_orders,
)
from thincam_jax.lensless.masks.openings import RadialMask
from thincam_jax.lensless.masks.phase import PhaseMask
from thincam_jax.lensless.propagation.skew import focuses_on_a_line

Model = Literal[
    "geometric",
    "paraxial",
    "closed_form",
    "separable",
    "radial",
    "angular_spectrum",
    "rayleigh_sommerfeld",
]
MODELS: tuple[Model, ...] = get_args(Model)
# Those of unbounded chirps, which cannot hold an edge or the pixels of a display; and those that
# sample the mask.
UNBOUNDED: tuple[Model, ...] = ("paraxial", "closed_form")
SAMPLED: tuple[Model, ...] = ("angular_spectrum", "rayleigh_sommerfeld")
CLOSED: tuple[Model, ...] = tuple(model for model in MODELS if model not in SAMPLED)

# Gauss-Legendre nodes a pixel for the pixel average, where the fringes are not known. Those
# of the far edge turn by up to 10 cycles over a 5.5 µm pixel at d = 6.5 mm, at a few parts in 1000
# of the amplitude: 8 nodes are 2e-3 off there, 16 8e-5, 24 1e-10.
PIXEL_NODES = 24
# Fewer nodes, and the fringes a pixel up to which their averages are exact to 1e-7 and 1e-13.
_FEWER: dict[Precision, dict[int, float]] = {
    "float32": {4: 0.3, 6: 0.85, 8: 1.55, 10: 2.385, 12: 3.25, 14: 4.2, 16: 5.15, 20: 7.15},
    "float64": {4: 0.05, 6: 0.25, 8: 0.6, 10: 1.15, 12: 1.75, 14: 2.45, 16: 3.2, 20: 4.85},
}
# More nodes, and how many more than half of π times the fringes they must be to follow these. At
# their end what they leave of a PSF, times their count and the root of the mask's width in pixels:
# an edge is in so many pixels.
_MORE, _BEYOND, _LEFT = (PIXEL_NODES, 32, 48, 64, 96, 128, 192, 320), 9.0, 1.25
# Points a pixel for its average then: 1 to 4 % off where a pixel holds some ten fringes.
LATTICE_POINTS = 21
# Samples in the mean of a cell and of an edge's zone, and samples a pixel where they are not known.
_IN_CELL, _UNKNOWN_CELL = 16, 7
_LATTICE = (
    "pixel averages of a mask of {} are taken at "
    f"{LATTICE_POINTS} points a pixel, 1 to 4 % off where cells are fine; "
    "PsfMethod({!r}, nodes=144) is five times closer, and takes seven times as long"
)


def parts_of(mask: AbstractMask) -> str:
    """Number of terms, rings or samples whose waves a model adds up, in words."""
    if isinstance(mask, AbstractFactoredMask):
        return f"{term_count(mask).terms} terms"
    return f"{mask.rings.size} rings" if isinstance(mask, RadialMask) else "samples"


def models_of(mask: AbstractMask) -> tuple[Model, ...]:
    """The models that can represent the mask."""
    fits = {
        **dict.fromkeys(UNBOUNDED, zone_orders(mask) is not None),
        **{model: mask.exact_model == model for model in ("separable", "radial")},
        "geometric": not mask.pure_phase,
    }
    return tuple(model for model in MODELS if fits.get(model, True))


@dataclass(frozen=True)
class PsfMethod:
    """A model of the PSF with its settings, in place of the model's name.

    - `model`: "geometric", "paraxial", "closed_form", "separable", "radial", "angular_spectrum" or
      "rayleigh_sommerfeld"; each is documented in `thincam_jax.lensless.propagation`. "separable",
      the default, is "radial" of rings, and "angular_spectrum" of rings off the axis and, off both
      axes, of cells and of zones that focus on a line there, with samples that leave about 1 %, 7 a
      pixel of traced numbers.
    - `precision`: "float32" or "float64", in which to compute; the result comes back in the
      camera's own, which is also the default. Double precision needs no setting of JAX's.
    - `pixel_integration`: average over each pixel, unless the function that is called does not.
    - `oversampling`: samples per pixel of the sampled models (odd; default 1, 3 for pixel
      averages, and more where a phase mask's cells are smaller than that), and of the profile that
      "radial" interpolates (by default counted); the others are closed forms and take none.
    - `mask_shape`: pixels of the plane on which the sampled models hold the mask; by default the
      smallest that does. Inside jit and grad, where the mask's size is not known, it is the
      sensor's: give it there if the mask is wider than the sensor.
    - `nodes`: nodes of the pixel average of "separable"; by default counted (`psf`). Gauss nodes an
      axis, or, for a mask of more than 128 terms and for "radial", points a pixel (21 by default).
    - `field_tolerance`: tolerance of captures: how far, relative, the PSFs of points off the axis
      may be from their own, which change over the field as does their light (`field_operator`). By
      default all points have the PSF and the light of the axis.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    camera = tc.LenslessCamera(tc.Pinhole(0.5), tc.Sensor((32, 48), 20 * um), distance=3.0)
    fine = tc.PsfMethod("angular_spectrum", oversampling=5)
    h = tc.psf(camera, wavelength=500 * nm, model=fine)
    ```

    **See also**: `psf`, `choose_model`.
    """

    model: Model = "separable"
    precision: Precision | None = None
    pixel_integration: bool = True
    oversampling: int | None = None
    mask_shape: tuple[int, int] | None = None
    nodes: int | None = None
    field_tolerance: float | None = None

    def __post_init__(self):
        checks.choice("model", self.model, MODELS)
        if self.precision is not None:
            checks.choice("precision", self.precision, PRECISIONS)
        if not isinstance(self.pixel_integration, bool):
            given = checks.shown(self.pixel_integration)
            raise TypeError(f"pixel_integration is {given}; give True or False")
        if self.nodes is not None:
            checks.whole("nodes", self.nodes, 1)
        if self.field_tolerance is not None:
            checks.positive("field_tolerance", self.field_tolerance, "parts of one")
        if self.model in SAMPLED:
            require_odd(self.samples)
        elif self.mask_shape or (self.oversampling is not None and self.model != "radial"):
            raise ValueError(
                f"model {self.model!r} is a closed form: leave oversampling and mask_shape out"
            )
        if self.mask_shape is not None:
            shape = checks.shape2d("mask_shape", self.mask_shape)
            object.__setattr__(self, "mask_shape", shape)

    @property
    def samples(self) -> int:
        """Samples a pixel; 1 where none are chosen."""
        return 1 if self.oversampling is None else self.oversampling

    @property
    def float_type(self) -> Precision:
        """The precision; float32 by default."""
        return self.precision or "float32"

    @property
    def averages_tolerance(self) -> float:
        """Error that averages over pixels may leave: a quarter of the field's tolerance.

        0 where that is 1, which asks for the light of every point, not for a coarse PSF.
        """
        given = self.field_tolerance or 0.0
        return given / 4 if given < 1 else 0.0


def as_method(model: Model | PsfMethod, pixel_integration: bool = True) -> PsfMethod:
    """A model's settings, given or by its name; averaged over pixels unless either says no."""
    method = model if isinstance(model, PsfMethod) else PsfMethod(model)
    return method if pixel_integration else replace(method, pixel_integration=False)


def psf_method(
    mask: AbstractMask, grid: Grid, model: Model | PsfMethod, pixel_integration: bool = True
) -> PsfMethod:
    """The settings with the defaults for a mask and grid in place of None.

    **Errors**: TypeError for "separable" of a mask without terms.
    """
    method = as_method(model, pixel_integration)
    precision = method.precision or precision_of(grid.pitch)
    method = replace(method, precision=precision, field_tolerance=None)
    if method.model == "separable" and isinstance(mask, RadialMask):
        method = replace(method, model="radial")
    if method.model == "separable" and not isinstance(mask, AbstractFactoredMask):
        raise TypeError(
            "model 'separable' needs a mask of few separable terms, such as FresnelZoneAperture; "
            f"for a {type(mask).__name__} use {other_models(mask)}"
        )
    if method.model not in SAMPLED:
        counted = method.nodes or method.model != mask.exact_model or not method.pixel_integration
        if counted or has_few_terms(mask):
            return method
        text = _LATTICE.format(parts_of(mask), method.model)
        warnings.warn(text, AccuracyWarning, stacklevel=6)
        return replace(method, nodes=LATTICE_POINTS)
    least = 3 if method.pixel_integration else 1
    return replace(
        method,
        oversampling=method.oversampling or max(least, _samples_of_cells(mask, grid)),
        mask_shape=method.mask_shape or _mask_plane(mask, grid),
    )


def sampled_off_axis(
    mask: AbstractMask, grid: Grid, path: LightPath, method: PsfMethod
) -> PsfMethod:
    """The settings given, or those of samples where "separable" has no closed form.

    Rings have none off the axis; cells off both axes, whose integrals do not separate; and zones
    that focus on a line there. Samples of √(cz)/16, c a cell and z = √(λd/M) the zone of an
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


def require_odd(oversampling: int) -> None:
    if checks.whole("oversampling", oversampling, 1) % 2 == 0:
        raise ValueError(
            f"oversampling = {oversampling}: give an odd number, so that pixel centres are samples"
        )


def _samples_of_cells(mask: AbstractMask, grid: Grid) -> int:
    """Samples a pixel, odd, that are no larger than a phase mask's cells; 1 for traced sizes."""
    if not isinstance(mask, PhaseMask) or any(map(checks.is_traced, (mask.pitch, grid.pitch))):
        return 1
    return odd_from(float(np.asarray(grid.pitch) / np.asarray(mask.pitch)))


def odd_from(number: float) -> int:
    """The smallest odd count that is no less, but for rounding."""
    return 2 * math.ceil((number - 1e-4 - 1) / 2) + 1


def _mask_plane(mask: AbstractMask, grid: Grid) -> tuple[int, int] | None:
    """Pixels that hold the mask; None for a traced size: then the sensor's, checked when run."""
    known = not checks.holds_traced(mask)
    with jax.ensure_compile_time_eval() if known else nullcontext():  # known under jit, too
        sizes = [*mask.extent, grid.pitch, mask.centre]
    if any(checks.is_traced(s) for s in sizes):
        return None
    height, width, pitch, centre = (np.asarray(s) for s in sizes)
    reach = (np.array([height, width]) + 2 * np.abs(centre)) / pitch
    rows, columns = (max(1, math.ceil(r - 1e-4)) for r in reach)
    return rows, columns


def pixel_nodes(
    mask: AbstractMask, grid: Grid, path: LightPath, precision: Precision, tolerance: float = 0.0
) -> int:
    """Nodes that the pixel average needs; `PIXEL_NODES` while the numbers are traced.

    As many as follow its fringes, at most 320, or fewer that leave the tolerance.
    """
    known = _fringes(mask, grid, path)
    if known is None:
        return PIXEL_NODES
    fringes, left = known
    for nodes, most in _FEWER[precision].items():
        if fringes <= most:
            return nodes
    enough = (n for n in _MORE if _follow(n, fringes) or left <= tolerance * n)
    return next(enough, _MORE[-1])


def with_nodes(method: PsfMethod, mask: AbstractMask, grid: Grid, path: LightPath) -> PsfMethod:
    """The settings with the nodes that the average of "separable" needs, unless it has some."""
    if method.model != "separable" or not method.pixel_integration or method.nodes is not None:
        return method
    nodes = pixel_nodes(mask, grid, path, method.float_type, method.averages_tolerance)
    return replace(method, nodes=nodes)


def average_error(mask: AbstractMask, grid: Grid, path: LightPath, nodes: int) -> float:
    """Relative error of the PSF, of nodes that do not follow the fringes; 0 of others."""
    known = _fringes(mask, grid, path)
    return 0.0 if known is None or _follow(nodes, known[0]) else known[1] / nodes


def _follow(nodes: int, fringes: float) -> bool:
    few = _FEWER["float32"].get(nodes, 0.0)
    return fringes <= few or nodes >= fringes * math.pi / 2 + _BEYOND


def _fringes(mask: AbstractMask, grid: Grid, path: LightPath) -> tuple[float, float] | None:
    """Fringes a pixel and the error of one node; None while the numbers are traced.

    The band of the irradiance ends at width/(λd): so many fringes there are at most.
    """
    numbers = (*mask.extent, grid.pitch, path.wavelength, path.distance)
    if checks.holds_traced(numbers):
        return None
    # In NumPy: inside jit, JAX would trace the product of known numbers too.
    height, width, pitch, wavelength, distance = map(float, map(np.asarray, numbers))
    fringes = pitch * max(height, width) / (wavelength * distance)
    return fringes, _LEFT * math.sqrt(pitch / min(height, width))
