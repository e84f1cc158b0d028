"""From a scene to what the camera captures."""

import functools
import math
import operator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax import _checks
from thincam_jax._memory import refuse_if_too_large
from thincam_jax.camera import LenslessCamera
from thincam_jax.grids import Grid, same_parity
from thincam_jax.operators import CropConvolution, kernel_grid, kernel_shape
from thincam_jax.psf import Model, psf
from thincam_jax.scene import ImagePlane, Scene
from thincam_jax.sensor import AbstractNoise, read_out


def capture(
    camera: LenslessCamera,
    scene: Scene,
    *,
    key: PRNGKeyArray | None = None,
    noise: AbstractNoise | None = None,
    model: Model = "separable",
    pixel_integration: bool = True,
) -> Float[Array, "*batch y x"]:
    r"""The captured image of a scene (thesis Eq 3.8): Σ over planes and wavelengths of h ∗ f_d.

    Each plane at t appears on the sensor turned by 180° and scaled by d/t (Eq 3.6, corrected), is
    convolved with the PSF of its distance and wavelength, and cropped to the sensor. The
    convolution is linear: nothing wraps round, and light that falls beside the sensor is lost. The
    PSF is shift-invariant: obliquity and vignetting are left out, which is right to a few per cent
    for fields under some 20° from the axis.

    **Arguments**

    - `scene`: planes with a common batch shape; the batch is captured image by image.
    - `noise`, `key`: see `thincam_jax.sensor`; without noise the result is deterministic.
    - `model`: PSF model, see `psf`.
    - `pixel_integration`: average the PSF over the pixels, as a real sensor does.

    **Returns** (*batch, y, x) in units of radiance × mm².
    """
    spectrum = scene.spectrum
    parts = (
        weight * expose(camera, plane, wavelength, model, pixel_integration)
        for plane in scene.planes
        for wavelength, weight in zip(spectrum.wavelengths, spectrum.weights, strict=True)
    )
    image = functools.reduce(operator.add, parts)
    return read_out(camera.sensor, image, noise=noise, key=key)


def expose(
    camera: LenslessCamera, plane: ImagePlane, wavelength, model: Model, pixel_integration: bool
) -> Float[Array, "*batch y x"]:
    """Noise-free capture of one plane at one wavelength."""
    shape = projected_shape(camera, plane)
    _check_memory(camera.sensor.shape, shape, plane.image.shape[:-2])
    convolution = imaging_operator(
        camera,
        wavelength,
        plane.distance,
        field_shape=shape,
        model=model,
        pixel_integration=pixel_integration,
    )
    return _project_and_convolve(camera, plane, convolution)


def imaging_operator(
    camera: LenslessCamera,
    wavelength,
    object_distance,
    *,
    field_shape: tuple[int, int],
    model: Model = "separable",
    pixel_integration: bool = True,
    grid: Grid | None = None,
) -> CropConvolution:
    """The operator from a plane's projection on the sensor's pitch to the noise-free capture."""
    grid = grid or camera.sensor.grid
    h = psf(
        camera,
        wavelength=wavelength,
        object_distance=object_distance,
        model=model,
        pixel_integration=pixel_integration,
        grid=kernel_grid(grid, field_shape),
    )
    return CropConvolution(h, grid.pitch, grid.shape, field_shape)


def projected_shape(camera: LenslessCamera, plane: ImagePlane) -> tuple[int, int]:
    """Pixels that the plane's image covers on the sensor's pitch; needs untraced numbers."""
    numbers = (camera.distance, plane.distance, camera.sensor.pitch, plane.width)
    if any(_checks.is_traced(n) for n in numbers):
        raise TypeError(
            "capture needs the plane's width and distance and the camera's distance and pitch as "
            "known numbers, because they set array sizes; build them outside of jit and grad, or "
            "use imaging_operator"
        )
    # In NumPy: inside jit, JAX would trace the product of known numbers too.
    distance, object_distance, pitch, width = (np.asarray(n) for n in numbers)
    aspect = plane.image.shape[-2] / plane.image.shape[-1]
    size = distance / object_distance / pitch * width * np.array([aspect, 1.0])
    rows, columns = (max(1, math.ceil(n - 1e-3)) for n in size)
    return same_parity((rows, columns), camera.sensor.shape)


@jax.jit
def _project_and_convolve(camera: LenslessCamera, plane: ImagePlane, convolution: CropConvolution):
    grid = Grid(convolution.field_shape, camera.sensor.pitch)
    field = plane.sample(grid, magnification=-camera.distance / plane.distance)
    return convolution(field.astype(convolution.spectrum.real.dtype))


def _check_memory(sensor_shape, field_shape, batch) -> None:
    rows, columns = kernel_shape(sensor_shape, field_shape)
    itemsize = jnp.zeros(()).dtype.itemsize
    images = 3 * math.prod(batch) + 4
    refuse_if_too_large(
        f"a capture of {sensor_shape[0]}×{sensor_shape[1]} pixels of an image projected on "
        f"{field_shape[0]}×{field_shape[1]}",
        images * rows * columns * itemsize,
        "use a smaller sensor, a smaller scene, or fewer images at a time",
    )
