"""The models of the PSF by name, and how one is computed."""

import math
from dataclasses import dataclass
from typing import Any, Literal, TypeGuard, cast, get_args

import numpy as np

from thincam_jax._core import checks
from thincam_jax._core.checks import Shape
from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import PRECISIONS, Precision, precision_of
from thincam_jax.lensless.masks.base import (
    AbstractFactoredMask,
    AbstractMask,
    term_count,
    zone_orders,
)
from thincam_jax.lensless.masks.phase import PhaseMask
from thincam_jax.lensless.propagation.angular_spectrum import require_odd
from thincam_jax.lensless.propagation.separable import PIXEL_NODES

Model = Literal[
    "geometric", "paraxial", "closed_form", "separable", "angular_spectrum", "rayleigh_sommerfeld"
]
MODELS: tuple[Model, ...] = get_args(Model)
# Those of unbounded chirps, which cannot hold an edge or the pixels of a display; and those that
# sample the mask.
UNBOUNDED: tuple[Model, ...] = ("paraxial", "closed_form")
SAMPLED: tuple[Model, ...] = ("angular_spectrum", "rayleigh_sommerfeld")
CLOSED: tuple[Model, ...] = tuple(model for model in MODELS if model not in SAMPLED)


# Terms of a mask up to which `separable` is offered: its work grows as their square.
_MOST_TERMS = 128


def has_few_terms(mask: AbstractMask) -> TypeGuard[AbstractFactoredMask]:
    """Whether the mask is a sum of so few products that `separable` serves it."""
    return isinstance(mask, AbstractFactoredMask) and term_count(mask).terms <= _MOST_TERMS


def models_of(mask: AbstractMask) -> tuple[Model, ...]:
    """The models that can represent the mask."""
    fits = {
        **dict.fromkeys(UNBOUNDED, zone_orders(mask) is not None),
        "separable": has_few_terms(mask),
        "geometric": not mask.pure_phase,
    }
    return tuple(model for model in MODELS if fits.get(model, True))


@dataclass(frozen=True)
class PsfMethod:
    """Method for computing a PSF: all that is static where JAX compiles; arguments as of `psf`.

    - `samples`, `mask_shape`: samples a pixel, and pixels of the mask plane, of the models that
      sample the mask; 1 and None for the closed forms, and None for a mask of traced size.
    - `nodes`: a pixel and axis, of the pixel average of `separable`.
    """

    model: Model
    precision: Precision = "float32"
    pixel_integration: bool = False
    samples: int = 1
    mask_shape: tuple[int, int] | None = None
    nodes: int = PIXEL_NODES

    @property
    def oversampling(self) -> int | None:
        """As `psf` takes it."""
        return self.samples if self.model in SAMPLED else None

    @property
    def arguments(self) -> dict[str, Any]:
        """Those of `psf`."""
        return {
            "model": self.model,
            "precision": self.precision,
            "pixel_integration": self.pixel_integration,
            "oversampling": self.oversampling,
            "mask_shape": self.mask_shape,
        }


def psf_method(
    mask: AbstractMask,
    grid: Grid,
    model: object,
    pixel_integration: bool = False,
    precision: object = None,
    oversampling: int | None = None,
    mask_shape: Shape | None = None,
) -> PsfMethod:
    """The arguments of `psf`, checked, with its defaults in place of None."""
    model = cast(Model, checks.choice("model", model, MODELS))
    precision = precision_of(grid.pitch) if precision is None else precision
    precision = cast(Precision, checks.choice("precision", precision, PRECISIONS))
    if model not in SAMPLED:
        if oversampling is not None or mask_shape is not None:
            raise ValueError(
                f"model {model!r} is a closed form: leave oversampling and mask_shape out"
            )
        return PsfMethod(model, precision, pixel_integration)
    if oversampling is None:
        oversampling = max(3 if pixel_integration else 1, _samples_of_cells(mask, grid))
    require_odd(oversampling)
    given = None if mask_shape is None else checks.shape2d("mask_shape", mask_shape)
    shape = given or _mask_plane(mask, grid)
    return PsfMethod(model, precision, pixel_integration, oversampling, shape)


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
    sizes = [*mask.extent, grid.pitch, mask.centre]
    if any(checks.is_traced(s) for s in sizes):
        return None
    height, width, pitch, centre = (np.asarray(s) for s in sizes)
    reach = (np.array([height, width]) + 2 * np.abs(centre)) / pitch
    rows, columns = (max(1, math.ceil(r - 1e-4)) for r in reach)
    return rows, columns
