"""From a camera to its point spread function and optical transfer function."""

import math
from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Shape
from thincam_jax._core.grids import Grid
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax._core.precision import PRECISIONS, Precision, allow, as_complex, cast, precision_of
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.cost import psf_cost
from thincam_jax.lensless.digits import require_digits
from thincam_jax.lensless.masks.base import AbstractMask
from thincam_jax.lensless.propagation.angular_spectrum import angular_spectrum, require_odd
from thincam_jax.lensless.propagation.chirp_sum import ChirpSum
from thincam_jax.lensless.propagation.closed_form import closed_form, in_focus
from thincam_jax.lensless.propagation.geometric import geometric
from thincam_jax.lensless.propagation.paraxial import paraxial
from thincam_jax.lensless.propagation.path import Path
from thincam_jax.lensless.propagation.rayleigh_sommerfeld import rayleigh_sommerfeld
from thincam_jax.lensless.propagation.separable import PIXEL_NODES, separable
from thincam_jax.lensless.propagation.separable_sum import SeparableSum, centre_phase

Model = Literal[
    "geometric",
    "paraxial",
    "closed_form",
    "separable",
    "angular_spectrum",
    "rayleigh_sommerfeld",
]
MODELS: tuple[Model, ...] = get_args(Model)
# Those of unbounded chirps, which cannot hold an edge or the pixels of a display; and those that
# sample the mask.
UNBOUNDED: tuple[Model, ...] = ("paraxial", "closed_form")
SAMPLED: tuple[Model, ...] = ("angular_spectrum", "rayleigh_sommerfeld")
CLOSED: tuple[Model, ...] = tuple(model for model in MODELS if model not in SAMPLED)


def psf(
    camera: LenslessCamera,
    *,
    wavelength: Number,
    object_distance: Number = math.inf,
    model: Model = "separable",
    pixel_integration: bool = False,
    grid: Grid | None = None,
    oversampling: int | None = None,
    mask_shape: tuple[int, int] | None = None,
    precision: Precision | None = None,
) -> Float[Array, "y x"]:
    """Point spread function on the sensor: irradiance relative to the open aperture.

    **Arguments**

    - `wavelength`: λ, mm.
    - `object_distance`: t, mm; the point lies on the axis. Infinity is a plane wave.
    - `model`: "geometric", "paraxial", "closed_form", "separable", "angular_spectrum" or
      "rayleigh_sommerfeld"; each is documented in `thincam_jax.lensless.propagation`.
    - `pixel_integration`: average over each pixel in place of the value at its centre.
    - `grid`: where to evaluate; the sensor's pixels by default.
    - `oversampling`: samples per pixel of the sampled models (odd; default 1, and 3 for pixel
      averages); the others are closed forms and take none.
    - `mask_shape`: pixels of the plane on which the sampled models hold the mask; by default the
      smallest that does. Inside jit and grad, where the mask's size is not known, it is the
      sensor's: give it there if the mask is wider than the sensor.
    - `precision`: "float32" or "float64", in which to compute; the result comes back in the
      camera's own, which is also the default. Double precision needs no setting of JAX's.

    **Returns** (y, x), dimensionless. Differentiable in every number of `camera` and in
    `wavelength` and `object_distance`.

    **Errors**: ValueError for what is out of range, for unknown models and for phases that float32
    does not hold (see `thincam_jax.lensless.digits`), TypeError for a mask
    that the model cannot take, MemoryError (before any work, with the estimate) for a size that
    does not fit.
    """
    path, grid = _prepare(camera, wavelength, object_distance, model, grid)
    sampling = sampling_of(camera, grid, model, pixel_integration, oversampling, mask_shape)
    return _evaluate(_psf, camera.mask, grid, path, model, pixel_integration, sampling, precision)


def otf(
    camera: LenslessCamera,
    *,
    wavelength: Number,
    object_distance: Number = math.inf,
    model: Model = "separable",
    pixel_integration: bool = False,
    grid: Grid | None = None,
    oversampling: int | None = None,
    mask_shape: tuple[int, int] | None = None,
    precision: Precision | None = None,
) -> Complex[Array, "v u"]:
    """Optical transfer function H(u,v) = ∬ h e^{−2πj(ux+vy)} dx dy, zero frequency at n//2, mm².

    Arguments as for `psf`. For the models with an edge it is the transform of the PSF on the grid
    (sum times pitch²). For "paraxial" and "closed_form", whose PSF has no end, it is the
    analytic transform, without pixel average: a δ at zero frequency is one over the area of a
    frequency cell.
    """
    path, grid = _prepare(camera, wavelength, object_distance, model, grid)
    sampling = sampling_of(camera, grid, model, pixel_integration, oversampling, mask_shape)
    return _evaluate(_otf, camera.mask, grid, path, model, pixel_integration, sampling, precision)


def _irradiance(
    mask: AbstractMask,
    grid: Grid,
    path: Path,
    model: Model,
    pixel_integration: bool,
    mask_shape: tuple[int, int] | None,
    oversampling: int,
) -> SeparableSum | ChirpSum | Float[Array, "y x"]:
    """The PSF in the form in which the model has it: terms where there are terms, else an image."""
    if model not in SAMPLED:
        mask = _unfocused(mask, path) if model == "closed_form" else mask
        return _closed(mask, grid, path, model, pixel_integration, PIXEL_NODES)
    sampled = angular_spectrum if model == "angular_spectrum" else rayleigh_sommerfeld
    return sampled(
        mask,
        grid,
        path,
        mask_shape=mask_shape,
        oversampling=oversampling,
        pixel_integration=pixel_integration,
    )


def _closed(
    mask: AbstractMask, grid: Grid, path: Path, model: Model, pixel_integration: bool, nodes: int
) -> SeparableSum | ChirpSum | Float[Array, "y x"]:
    if model == "geometric":
        return geometric(mask, grid, path, pixel_integration=pixel_integration)
    if model == "separable":
        return separable(mask, grid, path, pixel_integration=pixel_integration, nodes=nodes)
    return paraxial(mask, path) if model == "paraxial" else closed_form(mask, path)


@jax.jit(static_argnames=("model", "pixel_integration", "nodes"))
def closed_terms(
    mask: AbstractMask,
    grid: Grid,
    path: Path,
    model: Model,
    pixel_integration: bool,
    nodes: int = PIXEL_NODES,
) -> SeparableSum:
    """The PSF of a mask with zone orders by one of the closed forms, as separable terms.

    `nodes`: of the pixel average of `separable`.
    """
    h = _closed(mask, grid, path, model, pixel_integration, nodes)
    if isinstance(h, ChirpSum):
        h = h.sample(grid, pixel_integration=pixel_integration)
    assert isinstance(h, SeparableSum)  # of a mask with zone orders
    return h


_STATIC = ("model", "pixel_integration", "mask_shape", "oversampling")


@jax.jit(static_argnames=_STATIC)
def _psf(mask, grid, path, model, pixel_integration, mask_shape, oversampling):
    h = _irradiance(mask, grid, path, model, pixel_integration, mask_shape, oversampling)
    if isinstance(h, ChirpSum):
        h = h.sample(grid, pixel_integration=pixel_integration)
    return h.image() if isinstance(h, SeparableSum) else h


@jax.jit(static_argnames=_STATIC)
def _otf(mask, grid, path, model, pixel_integration, mask_shape, oversampling):
    h = _irradiance(mask, grid, path, model, pixel_integration, mask_shape, oversampling)
    if isinstance(h, ChirpSum):
        return h.transform(grid)
    if isinstance(h, SeparableSum):
        return h.transform()
    spectrum = jnp.fft.fftshift(jnp.fft.fft2(h)) * as_complex(grid.pitch**2)
    rows, columns = (centre_phase(n, grid.pitch.dtype) for n in grid.shape)
    return spectrum * rows[:, None] * columns


def _prepare(camera, wavelength, object_distance, model, grid) -> tuple[Path, Grid]:
    checks.choice("model", model, MODELS)
    return camera.path(wavelength, object_distance), grid or camera.sensor.grid


def _evaluate(function, mask, grid, path, model, pixel_integration, sampling, precision):
    """In the precision asked for; the result comes back in the camera's."""
    own = precision_of(grid.pitch)
    precision = own if precision is None else precision
    checks.choice("precision", precision, PRECISIONS)
    with allow(precision, mask, grid, path):
        if precision != own:
            mask, grid, path = cast((mask, grid, path), precision)
        if precision == "float32":
            require_digits(mask, grid, path, model)
        _check_memory(mask, grid, model, pixel_integration, *sampling)
        result = function(mask, grid, path, model, pixel_integration, *sampling)
    return result if precision == own else cast(result, own)


def sampling_of(
    camera: LenslessCamera,
    grid: Grid,
    model: Model,
    pixel_integration: bool,
    oversampling: int | None,
    mask_shape: Shape | None,
) -> tuple[tuple[int, int] | None, int]:
    """Mask plane in pixels and samples per pixel, for the models that sample."""
    if model not in SAMPLED:
        if oversampling is not None or mask_shape is not None:
            raise ValueError(
                f"model {model!r} is a closed form: leave oversampling and mask_shape out"
            )
        return None, 1
    if oversampling is None:
        oversampling = 3 if pixel_integration else 1
    require_odd(oversampling)
    if mask_shape is not None:
        return checks.shape2d("mask_shape", mask_shape), oversampling
    sizes = [*camera.mask.extent, grid.pitch, camera.mask.centre]
    if any(checks.is_traced(s) for s in sizes):
        return None, oversampling  # the size cannot be looked at: the sensor's, checked when run
    height, width, pitch, centre = (np.asarray(s) for s in sizes)
    reach = (np.array([height, width]) + 2 * np.abs(centre)) / pitch
    rows, columns = (max(1, math.ceil(r - 1e-4)) for r in reach)
    return (rows, columns), oversampling


def _check_memory(mask, grid: Grid, model: Model, pixel_integration, mask_shape, oversampling):
    rows, columns = grid.shape
    cost = psf_cost(
        mask,
        grid,
        model,
        pixel_integration=pixel_integration,
        mask_shape=mask_shape,
        oversampling=oversampling,
        itemsize=jnp.dtype(grid.pitch.dtype).itemsize,
    )
    refuse_if_too_large(
        f"a PSF of {rows}×{columns} pixels by model {model!r}",
        cost.bytes,
        "use a smaller grid"
        + ("" if model == "separable" else ", less oversampling or the model 'separable'"),
    )


def _unfocused(mask: AbstractMask, path: Path) -> AbstractMask:
    return eqx.error_if(
        mask,
        in_focus(mask, path),
        "model 'closed_form' has no PSF where an order focuses on the sensor (k·ε = −1); "
        "use 'separable'",
    )
