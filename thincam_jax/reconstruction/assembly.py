"""Assembly of the inverse problem of convolutions: window, operators and weights."""

import math
from collections.abc import Sequence
from typing import Any

from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.memory import refuse_if_too_large
from thincam_jax.imaging.operators.crop_convolution import CropConvolution, window_shape
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
        window_shape(c.capture.shape[-2:], field_shape, c.kernel.shape[-2:]) for c in channels
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


def fitting_field(
    field_shape: Sequence[int], sensor: Sequence[int], kernel: Sequence[int]
) -> tuple[int, int]:
    """The field, smaller by one where its centre would not fit the sensor's and PSF's samples."""
    shape = checks.shape2d("field_shape", field_shape)
    sizes = zip(shape, sensor, kernel, strict=True)
    rows, columns = (max(f - (s + f - 1 - k) % 2, 1) for f, s, k in sizes)
    return rows, columns
