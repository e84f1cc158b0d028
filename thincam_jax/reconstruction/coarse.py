r"""A problem on pixels twice as large, whose solution is the start for all pixels.

Light that varies slowly takes ADMM the most iterations, and a quarter of the pixels holds it. With
B the mean over blocks of 2 × 2 pixels and U the image whose pixels are repeated 2 × 2 times,

.. math:: \tfrac12 \sum w (A U f - g)^2 + \tau R(U f)
    = \tfrac12 \sum w_c (B A U f - B g)^2 + 2 \tau R(f) + \text{const}

up to the variation of A U f within blocks, where w_c is the sum of the weights of a block. B A U is
a convolution with every second sample of the PSF, filtered with (1, 2, 1)/2 along both axes.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.grids import block_mean, block_sum
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import window_shape
from thincam_jax.reconstruction.problem import InverseProblem, convolutions, or_one
from thincam_jax.reconstruction.regularisers import Image

_SIZE = 2  # fine pixels along a coarse one
_SMALLEST = 48  # coarse pixels along the shorter side


def coarser(
    problem: InverseProblem, image: Image
) -> tuple[InverseProblem, Float[Array, "..."]] | None:
    """The problem and its start image on pixels twice as large.

    None if they are too few to pay, with several planes, or for operators that are no convolutions.
    """
    operators = convolutions(problem)
    if operators is None or problem.image_shape[-3] > 1:
        return None
    shapes = [o.sensor_shape for o in operators] + [problem.field_shape]
    if min(min(shape) for shape in shapes) < _SIZE * _SMALLEST:
        return None
    return _coarser(problem, operators, image)


def coarsened(
    problem: InverseProblem, image: Image, times: int
) -> tuple[InverseProblem, Float[Array, "..."], int]:
    """The problem on pixels halved in number up to so many times, its start, and their size."""
    size = 1
    while size < _SIZE**times and (smaller := coarser(problem, image)) is not None:
        (problem, image), size = smaller, _SIZE * size
    return problem, image, size


def finer(image: Image, shape: tuple[int, int]) -> Float[Array, "..."]:
    """An image of `coarser` on the pixels of the field, interpolated linearly."""
    fine = np.asarray(image)
    for axis in (-1, -2):  # on the host, where nothing is compiled
        fine = np.moveaxis(fine, axis, 0)
        padded = np.concatenate([fine[:1], fine, fine[-1:]])
        halves = [0.75 * fine + 0.25 * beside for beside in (padded[:-2], padded[2:])]
        fine = np.moveaxis(np.stack(halves, axis=1).reshape(-1, *fine.shape[1:]), 0, axis)
    return jnp.asarray(fine[..., : shape[0], : shape[1]])


@jax.jit
def _coarser(problem: InverseProblem, operators: tuple[CropConvolution, ...], image: Image):
    captures, weights = [], []
    for capture, weight in zip(problem.captures, problem.weights, strict=True):
        whole = jnp.broadcast_to(weight, jnp.broadcast_shapes(weight.shape, capture.shape[-2:]))
        even = tuple(slice(n - n % _SIZE) for n in capture.shape[-2:])
        total = block_sum(whole[..., *even], _SIZE)
        captures.append(block_sum((whole * capture)[..., *even], _SIZE) / or_one(total))
        weights.append(total)
    coarse = eqx.tree_at(
        lambda p: (p.operators, p.captures, p.weights, p.tau_unit),
        problem,
        (_coarse_operators(operators), tuple(captures), tuple(weights), _SIZE * problem.tau_unit),
    )
    odd = [(0, -n % _SIZE) for n in image.shape[-2:]]
    padded = jnp.pad(image, [(0, 0)] * (image.ndim - 2) + odd, mode="edge")
    return coarse, block_mean(padded, _SIZE)


def _coarse_operators(operators: tuple[CropConvolution, ...]) -> tuple[CropConvolution, ...]:
    """B A U of convolutions, on one window; spectra of shape (channel, plane, v, u)."""
    field = _halved(operators[0].field_shape, up=True)
    sensors = [_halved(o.sensor_shape) for o in operators]
    kernels = [
        _coarse_kernel(o, sensor, field) for o, sensor in zip(operators, sensors, strict=True)
    ]
    pairs = list(zip(kernels, sensors, strict=True))
    rows, columns = zip(*(window_shape(s, field, k.shape[-2:]) for k, s in pairs), strict=True)
    window = max(rows), max(columns)
    return tuple(CropConvolution(k, 1.0, s, field, summed=1, window=window) for k, s in pairs)


def _coarse_kernel(operator: CropConvolution, sensor: tuple[int, int], field: tuple[int, int]):
    """Every second sample of the kernel filtered with (1, 2, 1)/2, at all differences it has."""
    kernel = jnp.fft.irfft2(operator.spectrum, s=operator.window)
    for i, axis in enumerate((-2, -1)):
        kernel += (jnp.roll(kernel, 1, axis) + jnp.roll(kernel, -1, axis)) / 2
        window, count = operator.window[i], sensor[i] + field[i] - 1
        # Those that `window_shape` left room for; an even number less than all.
        surplus = max(0, (2 * count - window - 1) // 2)
        first = operator.sensor_corner[i] - operator.field_corner[i]
        places = first + _SIZE * (np.arange(surplus, count - surplus) - (field[i] - 1))
        kernel = jnp.take(kernel, places % window, axis=axis)
    return kernel


def _halved(shape: tuple[int, int], *, up: bool = False) -> tuple[int, int]:
    rows, columns = ((n + up * (_SIZE - 1)) // _SIZE for n in shape)
    return rows, columns
