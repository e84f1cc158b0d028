"""Small deconvolution problems that the tests of the iterative methods share."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import kernel_shape
from thincam_jax.reconstruction.problem import InverseProblem

SENSOR, FIELD = (24, 29), (18, 21)


def zone_plate(shape, phase=0.0, curvature=0.06):
    """A shadow of zones within a square aperture: values from 0 to 1."""
    y, x = (np.arange(n) - (n - 1) / 2 for n in shape)
    inside = (np.abs(y)[:, None] < shape[0] / 4) & (np.abs(x) < shape[1] / 4)
    return inside * (1 + np.cos(curvature * (y[:, None] ** 2 + x**2) + phase)) / 2


def spots(shape, seed=7, count=4):
    """A few soft points, most of the light in one: easier to undo than zones."""
    rng = np.random.default_rng(seed)
    y, x = np.indices(shape)
    kernel = np.zeros(shape)
    for n in range(count):
        y0, x0 = ((s - 1) / 2 + rng.integers(-s // 8, s // 8 + 1) for s in shape)
        kernel += np.exp(-((y - y0) ** 2 + (x - x0) ** 2) / 0.4) / (1 + n)
    return kernel


def blocks(shape=FIELD, seed=3, count=5):
    """A scene of even rectangles on a dark ground, none of its sides alike."""
    rng = np.random.default_rng(seed)
    image = np.full(shape, 0.1)
    for _ in range(count):
        top, left = (rng.integers(0, max(1, n - n // 4)) for n in shape)
        rows, columns = (rng.integers(1, n // 2 + 2) for n in shape)
        image[top : top + rows, left : left + columns] += rng.uniform(0.2, 1.0)
    return image


def convolution(
    sensor=SENSOR, field=FIELD, *, phase=0.0, planes=1, channels=1, pitch=0.2, kernel=zone_plate
):
    """A crop-convolution with zone plates, finer from plane to plane and channel to channel."""
    shape = kernel_shape(sensor, field)
    grid = [(c, p) for c in range(channels) for p in range(planes)]
    if kernel is spots:
        kernels = [spots(shape, seed=7 + c + 10 * p + int(10 * phase)) for c, p in grid]
    else:
        kernels = [zone_plate(shape, phase, 0.06 * (1 + 0.3 * p) * (1 + 0.1 * c)) for c, p in grid]
    stack = np.reshape(kernels, (channels, planes, *shape))
    return CropConvolution(jax.device_put(stack), pitch, sensor, field, summed=1)


def inverse(operators, captures, *, tau, **settings):
    """A problem with τ in absolute units, as the dense references want it."""
    return absolute(InverseProblem(operators, captures, **settings), tau)


def absolute(problem: InverseProblem, tau) -> InverseProblem:
    """The problem with another τ, given in absolute units."""
    tau = jnp.asarray(tau, problem.tau.dtype)
    return eqx.tree_at(lambda p: p.tau, problem, tau / problem.tau_unit)


def problem(
    sensor=SENSOR,
    field=FIELD,
    *,
    tau=1e-3,
    noise=0.002,
    captures=2,
    planes=1,
    channels=1,
    batch=(),
    kernel=zone_plate,
    **settings,
):
    """A problem, and the image (*batch, channel, plane, y, x) that its captures were made of."""
    operators = [
        convolution(
            sensor, field, phase=1.5 * np.pi * k, planes=planes, channels=channels, kernel=kernel
        )
        for k in range(captures)
    ]
    count = int(np.prod(batch, dtype=int)) * channels * planes
    truth = np.stack([blocks(field, seed=3 + n) for n in range(count)])
    truth = jax.device_put(truth.reshape(*batch, channels, planes, *field))
    rng = np.random.default_rng(11)
    seen = [np.asarray(operator(truth)) for operator in operators]
    noisy = [g + noise * g.max() * rng.normal(size=g.shape) for g in seen]
    return inverse(operators, noisy, tau=tau, **settings), truth


def single(problem: InverseProblem) -> InverseProblem:
    """The same in float32."""

    def cast(leaf):
        kinds = {jnp.dtype("float64"): jnp.float32, jnp.dtype("complex128"): jnp.complex64}
        return leaf.astype(kinds.get(leaf.dtype, leaf.dtype))

    return jax.tree.map(cast, problem)


def rescaled(problem: InverseProblem, factor: float) -> InverseProblem:
    """All captures, and τ with them, times a factor: the minimiser is that times the factor."""
    captures = tuple(c * jnp.asarray(factor, c.dtype) for c in problem.captures)
    tau = problem.tau * jnp.asarray(factor, problem.tau.dtype)
    return eqx.tree_at(lambda p: (p.captures, p.tau), problem, (captures, tau))
