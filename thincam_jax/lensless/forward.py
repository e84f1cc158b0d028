"""Noise-free image of one plane of a scene on the sensor."""

import functools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number
from thincam_jax._core.grids import Grid, same_parity
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import convolution_cost, kernel_grid
from thincam_jax.imaging.operators.low_rank import LowRank
from thincam_jax.imaging.scene import ImagePlane, Spectrum
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.field import field_fit
from thincam_jax.lensless.method import Model, PsfMethod, as_method
from thincam_jax.lensless.psf import spectral_psf

Colours = Sequence[tuple[Number, Number]]

# Pixels by which a field grows where an image moves.
_STEP = 16
_WIDE = 8  # times the sensor that a scene is cast, of which units are named


def expose(
    camera: LenslessCamera, plane: ImagePlane, colours: Colours, method: PsfMethod
) -> Float[Array, "*batch y x"]:
    """Noise-free capture of one plane: its projection convolved with the PSF of its light.

    `colours`: pairs of wavelength, mm, and weight.
    """
    shape = projected_shape(camera, plane)
    shape = shape if method.field_tolerance else in_steps(shape)
    check_memory(camera.sensor, shape, plane.image.shape[:-2])
    seen = operator_of(camera, colours, plane.distance, shape, method)
    field = project(camera, plane, shape)
    if field.ndim == 2 or checks.holds_traced(field, seen):
        return seen(field)
    # One at a time: in half of the time of all at once, and by one program for any number.
    pictures = checks.each(checks.at_hand(field).reshape(-1, *shape))
    captures = checks.stacked([seen(checks.as_array(one)) for one in pictures])
    return captures.reshape(*field.shape[:-2], *camera.sensor.shape)


def imaging_operator(
    camera: LenslessCamera,
    light: Spectrum | Number,
    object_distance: Number,
    *,
    field_shape: tuple[int, int],
    model: Model | PsfMethod = "separable",
    pixel_integration: bool = True,
) -> CropConvolution | LowRank:
    """The operator from a plane's projection on the sensor's pitch to the noise-free capture.

    `light` is a `Spectrum` or one wavelength in mm; the PSF is the weighted sum over it. The other
    arguments are those of `psf`. With a `field_tolerance` it is a `field_operator`.
    """
    spectrum = light if isinstance(light, Spectrum) else Spectrum(light)
    method = as_method(model, pixel_integration)
    return operator_of(camera, spectrum.colours, object_distance, field_shape, method)


def operator_of(
    camera: LenslessCamera,
    colours: Colours,
    object_distance: Number,
    field_shape: tuple[int, int],
    method: PsfMethod,
) -> CropConvolution | LowRank:
    """Operator from a plane's projection to its capture, for (wavelength, weight) pairs."""
    if method.field_tolerance is not None:
        return field_fit(camera, colours, object_distance, field_shape, method).operator
    grid = camera.sensor.grid
    wide = kernel_grid(grid, field_shape)
    kernel = spectral_psf(camera, colours, object_distance, method, wide)
    return CropConvolution(kernel, grid.pitch, grid.shape, field_shape)


def projected_shape(camera: LenslessCamera, plane: ImagePlane) -> tuple[int, int]:
    """Pixels that the plane's image covers on the sensor's pitch; needs untraced numbers."""
    moves = 0.0 if plane.moves is None else plane.moves
    numbers = (camera.distance, plane.distance, camera.sensor.pitch, plane.width, moves)
    if any(checks.is_traced(n) for n in numbers):
        raise TypeError(
            "capture needs the plane's width and distance and the camera's distance and pitch as "
            "known numbers, because they set array sizes; build them outside of jit and grad, or "
            "use imaging_operator"
        )
    # In NumPy: inside jit, JAX would trace the product of known numbers too.
    distance, object_distance, pitch, width, moves = (np.asarray(n) for n in numbers)
    aspect = plane.image.shape[-2] / plane.image.shape[-1]
    scale = distance / object_distance / pitch
    rows, columns = (max(1, math.ceil(scale * n - 1e-3)) for n in (width * aspect, width))
    # In steps, so that programs are shared along a way.
    columns += 2 * _STEP * math.ceil(scale * np.abs(moves).max() / _STEP)
    return same_parity((rows, columns), camera.sensor.shape)


def in_steps(shape: Sequence[int]) -> tuple[int, int]:
    """A shape enlarged to steps of a 16th to an 8th of it, of the same parity.

    Programs are shared while a distance or a pitch changes the size of a scene on the sensor.
    """
    rows, columns = (n + (n % 2 - n) % 2 ** max(0, int(n).bit_length() - 4) for n in shape)
    return rows, columns


@functools.partial(jax.jit, static_argnames="shape")
def project(
    camera: LenslessCamera, plane: ImagePlane, shape: tuple[int, int]
) -> Float[Array, "*batch m n"]:
    """The plane's image as a pinhole would cast it on `shape` samples of the sensor's pitch."""
    grid = Grid(shape, camera.sensor.pitch)
    return plane.sample(grid, magnification=-camera.distance / plane.distance)


def check_memory(sensor: Sensor, field_shape: tuple[int, int], batch: tuple[int, ...]) -> None:
    """Refuse a capture whose padded images do not fit."""
    rows, columns = sensor.shape
    cost = convolution_cost(
        sensor.shape, field_shape, math.prod(batch), jnp.dtype(sensor.pitch.dtype).itemsize
    )
    advice, wider = "", max(n / m for n, m in zip(field_shape, sensor.shape, strict=True))
    if wider > _WIDE:
        advice = (
            f"the scene is cast {wider:.0f} times as wide as the sensor: give lengths in mm, or "
        )
    refuse_if_too_large(
        f"a capture of {rows}×{columns} pixels of an image projected on "
        f"{field_shape[0]}×{field_shape[1]}",
        cost.bytes,
        f"{advice}use a smaller sensor, a smaller scene, or fewer images at a time",
    )
