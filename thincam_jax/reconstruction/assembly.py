"""Assembly of the inverse problem of captures and their PSFs: window, operators, weights."""

import math
from collections.abc import Sequence
from typing import Any

from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import cut, kernel_shape, window_shape
from thincam_jax.reconstruction.planes import warn_of_equal_planes
from thincam_jax.reconstruction.problem import InverseProblem


def convolution_problem(
    channels: Any,  # of `SynthesisRow`
    variances: Sequence[Array],
    pitch: Float[Array, ""],
    field_shape: tuple[int, int],
    settings: dict[str, Any],
) -> InverseProblem:
    """The problem of convolutions on one window."""
    dtype = channels[0].capture.dtype
    windows = [
        window_shape(
            c.capture.shape[-2:],
            field_shape,
            _kernel_extent(c.kernel, c.capture.shape[-2:], field_shape),
        )
        for c in channels
    ]
    window = (max(w[0] for w in windows), max(w[1] for w in windows))
    # Captures, kernels and a field, each with its transform, at the least.
    refuse_if_too_large(
        f"a reconstruction on a field of {field_shape[0]}×{field_shape[1]} pixels",
        dtype.itemsize * math.prod(window) * (2 * len(channels) + 3),
        "give a smaller field_shape, fewer pixels or fewer captures",
    )
    operators = [
        CropConvolution(
            c.kernel.astype(dtype),
            pitch.astype(dtype),
            c.capture.shape[-2:],
            field_shape,
            summed=1,
            window=window,
        )
        for c in channels
    ]
    weights = [
        (1.0 if c.valid is None else c.valid.astype(dtype)) / v
        for c, v in zip(channels, variances, strict=True)
    ]
    warn_of_equal_planes(operators, weights)
    return InverseProblem(operators, [c.capture for c in channels], weights=weights, **settings)


def centred_crop(
    image: Float[Array, "*batch y x"], shape: Sequence[int]
) -> Float[Array, "*batch v u"]:
    """The central part of an image, of this shape."""
    corner = [(n - s) // 2 for n, s in zip(image.shape[-2:], shape, strict=True)]
    return cut(image, corner, shape)


def _kernel_extent(kernel, sensor, field_shape) -> tuple[int, int]:
    """Kernel extent that reaches the sensor from the field."""
    most = kernel_shape(sensor, field_shape)
    rows, columns = (min(k, m) for k, m in zip(kernel.shape[-2:], most, strict=True))
    return rows, columns


def fitting_field(
    field_shape: Sequence[int], sensor: Sequence[int], kernel: Sequence[int]
) -> tuple[int, int]:
    """The field, smaller by one where its centre would not fit the sensor's and PSF's samples."""
    shape = checks.shape2d("field_shape", field_shape)
    sizes = zip(shape, sensor, kernel, strict=True)
    rows, columns = (max(f - (s + f - 1 - k) % 2, 1) for f, s, k in sizes)
    return rows, columns
