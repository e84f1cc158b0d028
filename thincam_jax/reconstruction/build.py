"""From captures, with cameras or measured PSFs, to a `Deconvolution`."""

import functools
import operator
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.grids import same_parity
from thincam_jax.imaging.operators import CropConvolution, kernel_grid, kernel_shape, window_shape
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.psf import Model, psf
from thincam_jax.reconstruction.noise import estimate_variance, given_variances
from thincam_jax.reconstruction.normal import mean_power
from thincam_jax.reconstruction.problem import Deconvolution
from thincam_jax.reconstruction.registration import distance_ratios, own_field, register
from thincam_jax.reconstruction.synthesis import check_synthesis, separate
from thincam_jax.reconstruction.total_variation import TotalVariation


def camera_problem(
    captures: Float[Array, "capture *batch y x"],
    cameras: Sequence[LenslessCamera],
    *,
    wavelength,
    object_distance,
    tau=2.0,
    noise_variance=None,
    synthesis=None,
    field_shape: tuple[int, int] | None = None,
    valid=None,
    variation: TotalVariation | None = None,
    nonnegative: bool = True,
    model: Model = "separable",
    pixel_integration: bool = True,
) -> Deconvolution:
    """The problem of captures by cameras that are known.

    Captures at several distances are enlarged to the scale of the largest (`register`), and their
    PSFs with them, as in `WienerSynthesis`; the field is sampled on that scale.

    **Arguments**: as in `thincam_jax.reconstruct`, and

    - `object_distance`: t, mm; several make as many planes, each seen in its own projection, so
      that pixels of the planes that are behind each other lie on one ray through the mask.
    - `tau`: see `absolute_tau`.
    - `synthesis`: real matrix (channel × capture) of sums of captures that are reconstructed in
      place of the captures; default: the captures. Sums in which the bright background cancels
      converge much faster.
    """
    captures, valid = _trusted(jnp.asarray(captures), valid)
    matrix = separate(len(cameras)) if synthesis is None else np.asarray(synthesis, dtype=float)
    ratios = distance_ratios(cameras)
    check_synthesis(matrix, cameras, ratios)
    sensor = cameras[0].sensor.grid
    field = same_parity(field_shape or sensor.shape, sensor.shape)
    distances = np.atleast_1d(np.asarray(object_distance, dtype=object))
    wavelengths = jnp.broadcast_to(jnp.asarray(wavelength), (len(cameras),))
    kernels = [
        jnp.stack(
            [
                _kernel(camera, light, t, own_field(field, ratio), ratio, model, pixel_integration)
                for t in distances
            ]
        )
        for camera, light, ratio in zip(cameras, wavelengths, ratios, strict=True)
    ]
    sums = [_Sum(row, kernels, captures, valid, ratios) for row in matrix]
    variances = [
        variance * s.ratio**2
        for variance, s in zip(
            _variances(matrix, noise_variance, captures, valid), sums, strict=True
        )
    ]
    return _assemble(
        [s.kernel for s in sums],
        [s.capture for s in sums],
        [s.valid for s in sums],
        variances,
        pitch=sensor.pitch,
        field_shape=field,
        tau=tau,
        variation=variation,
        nonnegative=nonnegative,
    )


def psf_problem(
    captures: Float[Array, "capture *batch y x"],
    psfs: Float[Array, "capture *planes k l"],
    *,
    tau=2.0,
    noise_variance=None,
    field_shape: tuple[int, int] | None = None,
    valid=None,
    variation: TotalVariation | None = None,
    nonnegative: bool = True,
) -> Deconvolution:
    """The problem of captures with measured PSFs on the same pixels.

    `psfs`: (capture, k, l), (capture, channel, k, l) or (capture, channel, plane, k, l), the
    channel axis of length 1 or that of the captures. The field is, if not given, all that sends
    light to the sensor: sensor + PSF − 1 samples.
    """
    captures, valid = _trusted(jnp.asarray(captures), valid)
    psfs = jnp.asarray(psfs)
    if not 3 <= psfs.ndim <= 5 or psfs.shape[0] != captures.shape[0]:
        raise ValueError(
            f"PSFs have shape {psfs.shape} for {captures.shape[0]} captures; give (capture, k, l), "
            "(capture, channel, k, l) or (capture, channel, plane, k, l)"
        )
    shape = (*psfs.shape[:-2], *(1,) * (5 - psfs.ndim), *psfs.shape[-2:])
    kernels = psfs.reshape(shape).astype(captures.dtype)
    sensor, kernel = captures.shape[-2:], kernels.shape[-2:]
    rows, columns = field_shape or (s + k - 1 for s, k in zip(sensor, kernel, strict=True))
    field = _fitting_field((rows, columns), sensor, kernel)
    variances = _variances(np.eye(captures.shape[0]), noise_variance, captures, valid)
    masks = [None] * len(kernels) if valid is None else list(valid)
    return _assemble(
        list(kernels),
        list(captures),
        masks,
        variances,
        pitch=jnp.ones((), captures.dtype),
        field_shape=field,
        tau=tau,
        variation=variation,
        nonnegative=nonnegative,
    )


def object_pitch(cameras: Sequence[LenslessCamera], object_distance) -> Float[Array, "*plane"]:
    """Distance of the field's pixels on the object, mm: p·t/d of the largest d, of each plane."""
    furthest = max(cameras, key=lambda c: float(c.distance))
    return furthest.sensor.pitch * jnp.asarray(object_distance) / furthest.distance


def absolute_tau(tau, operators, variances) -> Float[Array, ""]:
    r"""τ of a `Deconvolution` whose weights are 1/variance, from a number that is about 1.

    :math:`\tau = \tau_{rel}\,(\sum_k \mathrm{mean}|H_k|^2/\sigma_k^2)^{1/2}`: the standard
    deviation of a pixel of the back-projected noise, Σ Hᵀn/σ², on average over planes. A step
    between two pixels costs what noise alone would pay for it if τ_rel were 1; 1 to 3 suit most
    scenes, whatever the camera.
    """
    parts = [mean_power(o) / v for o, v in zip(operators, variances, strict=True)]
    total = functools.reduce(operator.add, parts)
    return jnp.asarray(tau, total.dtype) * jnp.sqrt(total)


class _Sum:
    """One row of a synthesis: its kernel, its capture, and where this is to be trusted."""

    def __init__(self, row: np.ndarray, kernels, captures, valid, ratios):
        used = [(float(w), k) for k, w in enumerate(row) if w]
        self.ratio = ratios[used[0][1]]
        self.kernel = functools.reduce(operator.add, [w * kernels[k] for w, k in used])
        whole = functools.reduce(operator.add, [w * captures[k] for w, k in used])
        self.capture = register(whole, self.ratio)
        self.valid = None
        if valid is not None or self.ratio > 1:
            both = jnp.ones(captures.shape[1:], bool)
            if valid is not None:
                both = jnp.all(jnp.stack([valid[k] for _, k in used]), axis=0)
            # A pixel that an invalid one, or the dark beyond the sensor, has been interpolated into
            # is not trusted either; the interpolation overshoots, too.
            seen = register(both.astype(captures.dtype), self.ratio)
            self.valid = jnp.abs(seen - 1) < 0.01


def _kernel(camera, wavelength, distance, field, ratio: float, model, pixel_integration):
    """PSF of a camera on the reference scale; enlarged, it spreads its light over ratio²."""
    grid = kernel_grid(camera.sensor.grid, field)
    own = psf(
        camera,
        wavelength=wavelength,
        object_distance=distance,
        grid=grid,
        model=model,
        pixel_integration=pixel_integration,
    )
    return register(own, ratio) / ratio**2


def _trusted(captures, valid):
    """Captures and the mask of their pixels; what is neither valid nor a number becomes 0."""
    if valid is None:
        return captures, None
    valid = jnp.asarray(valid, bool)
    try:
        valid = jnp.broadcast_to(valid, captures.shape)
    except ValueError:
        raise ValueError(
            f"valid has shape {valid.shape}; give a mask of the captures, {captures.shape}"
        ) from None
    return jnp.where(valid | jnp.isfinite(captures), captures, 0), valid


def _variances(matrix: np.ndarray, noise_variance, captures, valid) -> list[Float[Array, ""]]:
    """Variances of sums of captures: as given, or estimated where that is nothing or zero."""
    squares = [jnp.asarray(row**2, captures.dtype) for row in matrix]
    if noise_variance is None:
        each = estimate_variance(captures, valid)
        return [jnp.sum(square * each) for square in squares]
    given = given_variances(noise_variance, captures)
    totals = [jnp.sum(square * given) for square in squares]
    if all(not checks.is_traced(total) and bool(total > 0) for total in totals):
        return totals
    each = estimate_variance(captures, valid)
    return [
        jnp.where(total > 0, total, jnp.sum(square * each))
        for total, square in zip(totals, squares, strict=True)
    ]


def _assemble(
    kernels, captures, valid, variances, *, pitch, field_shape, tau, variation, nonnegative
) -> Deconvolution:
    """Operators on one window, and their weights."""
    captures = [c[None] if c.ndim == 2 else c for c in captures]
    dtype = captures[0].dtype
    kernels = [(k if k.ndim == 4 else k[None]).astype(dtype) for k in kernels]
    windows = [
        window_shape(c.shape[-2:], field_shape, _reach(k, c, field_shape))
        for k, c in zip(kernels, captures, strict=True)
    ]
    window = (max(w[0] for w in windows), max(w[1] for w in windows))
    operators = [
        CropConvolution(k, pitch.astype(dtype), c.shape[-2:], field_shape, summed=1, window=window)
        for k, c in zip(kernels, captures, strict=True)
    ]
    weights = [
        (1.0 if m is None else m.astype(c.dtype)) / v
        for m, v, c in zip(valid, variances, captures, strict=True)
    ]
    return Deconvolution(
        operators,
        captures,
        tau=absolute_tau(checks.non_negative("tau", tau, "parts of one"), operators, variances),
        weights=weights,
        variation=variation,
        nonnegative=nonnegative,
    )


def _reach(kernel, capture, field_shape) -> tuple[int, int]:
    """What of a kernel can send light from the field to the sensor."""
    most = kernel_shape(capture.shape[-2:], field_shape)
    rows, columns = (min(k, m) for k, m in zip(kernel.shape[-2:], most, strict=True))
    return rows, columns


def _fitting_field(field_shape, sensor, kernel) -> tuple[int, int]:
    """A field whose centre fits the sensor's and the PSF's samples: smaller by one if need be."""
    shape = checks.shape2d("field_shape", field_shape)
    sizes = zip(shape, sensor, kernel, strict=True)
    rows, columns = (max(f - (s + f - 1 - k) % 2, 1) for f, s, k in sizes)
    return rows, columns
