r"""A problem whose PSFs are cut to a smaller window, near an image that is nearly right.

Diffraction at the edges of a mask sends a ten-thousandth of the light far beyond its shadow, and
the window of the transforms has to hold it. With A = A′ + A″, of which A″ is the light beyond the
cut, and an image f₀ near the one sought,

.. math:: A f - g \approx A' f - (g - A'' f_0),

up to A″(f − f₀), some per cent of what is cut (docs/decisions/window_of_psf.md).
"""

import functools
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from thincam_jax._core.grids import fast_shape
from thincam_jax._core.quick_programs import quickly_compiled
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.reconstruction.problem import InverseProblem, convolutions, forward
from thincam_jax.reconstruction.regularisers import Image

# Light of a PSF beyond the cut, as a part of all, and of a capture, in units of the noise.
_BEYOND, _NOISES = 3e-4, 5.0


def with_cut_psfs(problem: InverseProblem, image: Image) -> InverseProblem:
    """The problem on the smallest window that suits it near an image; as it is where none does.

    - `image`: near the one sought, with the right low frequencies.
    """
    operators = convolutions(problem)
    if operators is None:
        return problem
    window = _smallest(operators, 0), _smallest(operators, 1)
    if window == operators[0].window:
        return problem
    cut, captures, beyond = _cut(problem, operators, image, window)
    if not float(beyond) < _NOISES:
        return problem
    return eqx.tree_at(lambda p: (p.operators, p.captures), problem, (cut, captures))


def _smallest(operators: Sequence[CropConvolution], axis: int) -> int:
    """The smallest of some fast sizes along an axis beyond which there is little light."""
    whole, lights = operators[0].window[axis], [_along(operator, axis) for operator in operators]
    least = max(max(o.sensor_shape[axis], o.field_shape[axis]) for o in operators)
    step = 2 ** max(0, whole.bit_length() - 6)  # few sizes, so that programs are shared
    for size in range(-(-least // step) * step, whole, step):
        if fast_shape((size, size), real=True)[0] != size:
            continue
        inside = [light[_kept(o, axis, size)] for o, light in zip(operators, lights, strict=True)]
        if all(i.sum() >= (1 - _BEYOND) * o.sum() for i, o in zip(inside, lights, strict=True)):
            return size
    return whole


def _along(operator: CropConvolution, axis: int) -> Float[np.ndarray, " w"]:
    """A PSF's light along an axis of its window, from a line of the spectrum: of sums across."""
    spectrum, size = np.asarray(operator.spectrum), operator.window[axis]
    if axis == 0:
        sums = np.fft.ifft(spectrum[..., :, 0]).real
    else:
        sums = np.fft.irfft(spectrum[..., 0, :], n=size)
    return np.abs(sums).reshape(-1, size).sum(axis=0)


def _kept(operator: CropConvolution, axis: int, size: int) -> np.ndarray:
    """Samples of the window with the differences of sensor and field that `size` samples hold."""
    sensor, field = operator.sensor_shape[axis], operator.field_shape[axis]
    count = sensor + field - 1
    margin = max(0, count - size)
    first = operator.sensor_corner[axis] - operator.field_corner[axis] - (field - 1)
    return (first + np.arange(margin, count - margin)) % operator.window[axis]


@functools.partial(quickly_compiled, static_argnames="window")
def _cut(
    problem: InverseProblem,
    operators: tuple[CropConvolution, ...],
    image: Image,
    window: tuple[int, int],
):
    """Operators of cut PSFs, captures without the light beyond, and that over the noise."""
    cut, captures, beyond = [], [], []
    for operator, capture, weight in zip(operators, problem.captures, problem.weights, strict=True):
        kernel = jnp.fft.irfft2(operator.spectrum, s=operator.window)
        for axis in (0, 1):
            kernel = jnp.take(kernel, _kept(operator, axis, window[axis]), axis=axis - 2)
        shapes = operator.sensor_shape, operator.field_shape
        cut.append(CropConvolution(kernel, 1.0, *shapes, summed=1, window=window))
        light = forward(operator, image) - forward(cut[-1], image)
        captures.append(capture - light)
        beyond.append(jnp.sqrt(jnp.mean(weight * light**2)))
    return tuple(cut), tuple(captures), jnp.max(jnp.stack(beyond))
