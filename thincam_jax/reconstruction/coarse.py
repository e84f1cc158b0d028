r"""A problem on larger pixels, whose solution is the start for all pixels.

Light that varies slowly takes ADMM the most iterations, and few pixels hold it. With B the mean
over blocks of s × s pixels and U the image whose pixels are repeated s × s times,

.. math:: \tfrac12 \sum w (A U f - g)^2 + \tau R(U f)
    = \tfrac12 \sum w_c (B A U f - B g)^2 + s \tau R(f) + \text{const}

up to the variation of A U f within blocks, where w_c is the sum of the weights of a block. B A U is
a convolution with every s-th sample of the PSF, filtered along both axes with a triangle, which is
(1, 2, 1)/2 for s = 2.
"""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.grids import block_mean, block_sum
from thincam_jax._core.quick_programs import quickly_compiled
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import window_shape
from thincam_jax.reconstruction.problem import InverseProblem, convolutions, or_one
from thincam_jax.reconstruction.regularisers import Image

_SMALLEST = 48  # coarse pixels along the shorter side


def coarser(
    problem: InverseProblem, image: Image, size: int = 2
) -> tuple[InverseProblem, Float[Array, "..."]] | None:
    """The problem and its start image on pixels `size` times as large.

    None if they are too few to pay, with several planes, or for operators that are no convolutions.
    """
    operators = convolutions(problem)
    if operators is None or problem.image_shape[-3] > 1:
        return None
    shapes = [o.sensor_shape for o in operators] + [problem.field_shape]
    if min(min(shape) for shape in shapes) < size * _SMALLEST:
        return None
    return _coarser(problem, operators, image, size)


def coarsened(
    problem: InverseProblem, image: Image, times: int
) -> tuple[InverseProblem, Float[Array, "..."], int]:
    """The problem on pixels twice as large up to so many times, its start, and their size."""
    for size in (2**n for n in range(times, 0, -1)):
        if (found := coarser(problem, image, size)) is not None:
            return *found, size
    return problem, image, 1


def finer(image: Image, shape: tuple[int, int]) -> Float[Array, "..."]:
    """An image of `coarser` on the pixels of the field, interpolated linearly, and again."""
    fine = np.asarray(image)
    while fine.shape[-2] < shape[0] or fine.shape[-1] < shape[1]:
        for axis in (-1, -2):  # on the host, where nothing is compiled
            fine = np.moveaxis(fine, axis, 0)
            padded = np.concatenate([fine[:1], fine, fine[-1:]])
            halves = [0.75 * fine + 0.25 * beside for beside in (padded[:-2], padded[2:])]
            fine = np.moveaxis(np.stack(halves, axis=1).reshape(-1, *fine.shape[1:]), 0, axis)
    return jnp.asarray(fine[..., : shape[0], : shape[1]])


@functools.partial(quickly_compiled, static_argnames="size")
def _coarser(
    problem: InverseProblem, operators: tuple[CropConvolution, ...], image: Image, size: int
):
    captures, weights = [], []
    for capture, weight in zip(problem.captures, problem.weights, strict=True):
        whole = jnp.broadcast_to(weight, jnp.broadcast_shapes(weight.shape, capture.shape[-2:]))
        even = tuple(slice(n - n % size) for n in capture.shape[-2:])
        total = block_sum(whole[..., *even], size)
        captures.append(block_sum((whole * capture)[..., *even], size) / or_one(total))
        weights.append(total)
    coarse = eqx.tree_at(
        lambda p: (p.operators, p.captures, p.weights, p.tau_unit),
        problem,
        (
            _coarse_operators(operators, size),
            tuple(captures),
            tuple(weights),
            size * problem.tau_unit,
        ),
    )
    odd = [(0, -n % size) for n in image.shape[-2:]]
    padded = jnp.pad(image, [(0, 0)] * (image.ndim - 2) + odd, mode="edge")
    return coarse, block_mean(padded, size)


def _coarse_operators(
    operators: tuple[CropConvolution, ...], size: int
) -> tuple[CropConvolution, ...]:
    """B A U of convolutions, on one window; spectra of shape (channel, plane, v, u)."""
    field = _shrunk(operators[0].field_shape, size, up=True)
    sensors = [_shrunk(o.sensor_shape, size) for o in operators]
    kernels = [
        _coarse_kernel(o, sensor, field, size) for o, sensor in zip(operators, sensors, strict=True)
    ]
    pairs = list(zip(kernels, sensors, strict=True))
    rows, columns = zip(*(window_shape(s, field, k.shape[-2:]) for k, s in pairs), strict=True)
    window = max(rows), max(columns)
    return tuple(CropConvolution(k, 1.0, s, field, summed=1, window=window) for k, s in pairs)


def _coarse_kernel(
    operator: CropConvolution, sensor: tuple[int, int], field: tuple[int, int], size: int
):
    """Samples of the kernel filtered with a triangle, at all differences it has."""
    rows, columns = (_triangle(n, size) for n in operator.window)
    spectrum = operator.spectrum
    filtered = np.outer(rows, columns[: spectrum.shape[-1]])
    kernel = jnp.fft.irfft2(spectrum * jnp.asarray(filtered, spectrum.dtype), s=operator.window)
    for i, axis in enumerate((-2, -1)):
        window, count = operator.window[i], sensor[i] + field[i] - 1
        # Those that `window_shape` left room for; an even number less than all.
        surplus = max(0, (size * count - window - 1) // size)
        first = operator.sensor_corner[i] - operator.field_corner[i]
        places = first + size * (np.arange(surplus, count - surplus) - (field[i] - 1))
        kernel = jnp.take(kernel, places % window, axis=axis)
    return kernel


def _triangle(count: int, size: int) -> np.ndarray:
    """Transfer function of the mean over `size` samples, repeated: real, of sum `size`."""
    places = np.arange(1 - size, size)
    waves = np.cos(2 * np.pi * np.outer(np.arange(count), places) / count)
    return waves @ (size - np.abs(places)) / size


def _shrunk(shape: tuple[int, int], size: int, *, up: bool = False) -> tuple[int, int]:
    rows, columns = ((n + up * (size - 1)) // size for n in shape)
    return rows, columns
