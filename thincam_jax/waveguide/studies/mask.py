"""A mask and a bare sensor behind a see-through screen, in place of its lens.

Each order of the screen casts the mask's shadow (`waveguide.screen_to_sensor`). The PSF changes
slowly over the field: it is computed at a few points, for a sum of few convolutions.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from thincam_jax import waveguide as wg
from thincam_jax._core import checks
from thincam_jax._core.checks import Numbers, Shape
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax._core.quantity import FieldError, check_fields, choice, quantity
from thincam_jax.imaging.operators import Matrix
from thincam_jax.imaging.operators.crop_convolution import kernel_grid
from thincam_jax.imaging.operators.low_rank import low_rank_psf
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.method import MODELS, Model
from thincam_jax.lensless.psf import psf
from thincam_jax.waveguide.camera import seen_size
from thincam_jax.waveguide.screen_to_sensor import ghost_images, ghost_psfs
from thincam_jax.waveguide.smear import SmearedRays
from thincam_jax.waveguide.system import system_matrix

MASK_MISTAKES = ("none", "shift_invariant", "no_ghosts")
_STEPS = 6  # to a first image, each of which leaves some per cent of the error
_TOGETHER = 32  # cells


def _odd(name: str, value: Any) -> int:
    if checks.whole(name, value, 3, 255) % 2 == 0:
        raise ValueError(f"{name} = {value} is even; give {value + 1}")
    return value


class MaskSystem(Matrix):
    """The matrix from an object's cells to the sensor, mm².

    - `errors`: errors of its PSFs, the `truncation_error` and `interpolation_error` of
      `LowRankFit`.
    """

    errors: tuple[float, float] = eqx.field(static=True)

    def __init__(self, matrix: Numbers, shapes: tuple[Shape, Shape], errors: tuple[float, float]):
        super().__init__(matrix, *shapes)
        self.errors = errors

    def __str__(self) -> str:
        """The errors in a sentence."""
        left, between = (f"{100 * error:.1g} %" for error in self.errors)
        return f"The PSFs leave out {left} at their points and some {between} between these."


@dataclass(frozen=True, eq=False)
class ScreenMask:
    """A mask in the place of the lens of a `SeeThroughCamera`.

    The camera's `focal_distance` is from the sensor to the mask, its `lens_distance` from the mask
    to the plate. Captures are irradiances relative to the open aperture, summed over it: mm².

    - `mask`: mask with its middle on the axis.
    - `model`: model of its PSFs, averaged over pixels; see `psf`.
    - `points`: along each side of the field, an odd number, at which they are computed.
    - `tolerance`: error of the sum of convolutions that is allowed, relative to the PSFs at these
      points.
    """

    mask: AbstractMask
    model: Annotated[Model, choice(MODELS)] = "separable"
    points: Annotated[int, quantity(check=_odd, least=3, most=255)] = 7
    tolerance: Annotated[float, quantity("parts of one", least=1e-6, most=0.5)] = 0.01

    def __post_init__(self):
        check_fields(self)

    def system(
        self, camera: wg.SeeThroughCamera, plane: wg.ObjectPlane, orders: int, mistake: str = "none"
    ) -> MaskSystem:
        """The matrix of a model of the camera, one of `MASK_MISTAKES`.

        **Errors**: ValueError where no light comes through, or the object has no first image;
        MemoryError where the matrix does not fit.
        """
        sensor, distance, middle = camera.sensor, camera.focal_distance, self.points // 2
        first, field = first_image(camera, plane)
        needed = 4 * math.prod(plane.shape) * (math.prod(sensor.shape) + math.prod(field))
        refuse_if_too_large("the matrix behind a mask", needed, "give fewer pixels or cells")
        points, count = field_points(field, sensor.grid.pitch, self.points), (self.points,) * 2
        orders = 1 if mistake == "no_ghosts" else orders
        images = ghost_images(camera, points, plane.distance, orders)
        level = images.weight[:, middle, middle].sum()
        if not level > 0:
            raise ValueError("no light on the axis reaches the mask by this screen")
        grid = kernel_grid(sensor.grid, field)

        def shadow(wavelength, source, place):
            # In the mask's plane, for a shadow that is this much larger.
            centre = place / (1 + distance / source)
            moved = eqx.tree_at(lambda mask: mask.centre, self.mask, centre)
            lensless = LenslessCamera(moved, sensor, distance).on_grid(grid)
            light = {"wavelength": wavelength, "object_distance": source}
            return psf(lensless, **light, model=self.model, pixel_integration=True)

        psfs = ghost_psfs(images, shadow) / level
        if mistake == "shift_invariant":
            psfs = jnp.broadcast_to(psfs[middle, middle], (*count, *psfs.shape[2:]))
        fit = low_rank_psf(psfs, sensor.pitch, sensor.shape, field, tolerance=self.tolerance)
        cells = jnp.asarray(first.T.toarray(), psfs.dtype).reshape(-1, *field)
        seen = jax.lax.map(fit.operator, cells, batch_size=_TOGETHER).reshape(len(cells), -1)
        errors = fit.truncation_error, fit.interpolation_error
        return MaskSystem(seen.T, (plane.shape, sensor.shape), errors)


def require_mask_fits(
    models: Sequence[str], colours: int, band_samples: int | None, tilt: Sequence[float]
) -> None:
    """Refuse what a screen with a mask has not; `models`: the mistake of each.

    **Errors**: FieldError, with the keys of a file.
    """
    if colours > 1:
        raise FieldError("a mask takes a hologram of one colour; give one", "hologram", "colours")
    if band_samples is not None:
        message = "the smear of the band is left out behind a mask; drop band_samples"
        raise FieldError(message, "band_samples")
    if any(tilt):
        raise FieldError("a mask is parallel to the plate; drop the tilt", "screen", "tilt")
    for number, mistake in enumerate(models):
        if mistake not in MASK_MISTAKES:
            message = f"{mistake!r} is of a camera with a lens; choose {' or '.join(MASK_MISTAKES)}"
            raise FieldError(message, "models", number, "mistake")


def field_points(
    shape: tuple[int, int], pitch: Float[Array, ""], count: int | None = None
) -> Float[Array, "y x 2"]:
    """First images, (y, x) mm, of all samples of a field, or of `count` along each side."""
    ends = [(n - 1) / 2 * float(pitch) for n in shape]
    y, x = (np.linspace(-e, e, count or n) for e, n in zip(ends, shape, strict=True))
    return jnp.asarray(np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1), pitch.dtype)


def first_image(
    camera: wg.SeeThroughCamera, plane: wg.ObjectPlane
) -> tuple[scipy.sparse.csr_array, tuple[int, int]]:
    """Matrix from the cells of a plane to their image by order 0 through the mask's middle.

    The image has samples of the sensor's pitch about the axis, each the mean of what it covers of
    the plane; also returned is how many rows and columns of them there are.

    **Errors**: ValueError where the screen does not show the whole plane.
    """
    pitch = camera.sensor.pitch
    half = np.array([plane.shape[0] / plane.shape[1], 1.0]) * float(plane.width) / 2
    around = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
    edge, scale = np.asarray(plane.centre) + half * around, float(seen_size(camera, plane) / pitch)
    places = np.zeros_like(edge)
    for _ in range(_STEPS):
        seen = wg.trace(
            camera, jnp.asarray(places, pitch.dtype), object_distance=plane.distance, orders=1
        ).points[0]
        places = places + (np.asarray(seen)[:, 1::-1] - edge) / scale
    rows, columns = np.abs(places).max(axis=0) / float(pitch)
    if not max(rows, columns) < 4096:
        raise ValueError("the object reaches beyond what the screen shows; give a smaller width")
    field = 2 * math.ceil(rows), 2 * math.ceil(columns)
    rays = wg.trace(camera, field_points(field, pitch), object_distance=plane.distance, orders=1)
    smeared = SmearedRays(rays.points[..., None, 1::-1], jnp.ones_like(rays.weight))
    size = float(pitch) * float(np.ptp(edge) / np.ptp(places))
    return system_matrix(smeared, plane, size, 1.0), field
