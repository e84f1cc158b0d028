r"""The error of the best linear estimate of training images, differentiated through the solver.

What the frequency-wise objectives leave out is all here: the sensor's crop, PSFs in closed form
with their edges, real images. Their captures g_c (`thincam_jax.design.training`), of noise σ_c²,
are restored as the best linear estimate under the prior η_f,

.. math:: \hat f = S z, \qquad
    \Big(1 + S \sum_c \frac{A_c^T A_c}{\sigma_c^2} S\Big) z
    = S \sum_c \frac{A_c^T g_c}{\sigma_c^2}, \qquad S = \eta_f^{1/2}

by conjugate gradients. Their derivative is taken implicitly, at the solution, by another solve.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax._core.precision import as_complex
from thincam_jax.design.design import Design
from thincam_jax.design.training import Channel, Training, channels_of, relative_error


def end_to_end_error(design: Design, training: Training) -> Float[Array, ""]:
    """Squared error of the restored images, as a part of their variance, averaged.

    The PSNR in dB is −10·log₁₀ of this, up to a constant of the images. NaN where conjugate
    gradients did not reach the tolerance.
    """
    return relative_error(restore(design, training), training)


def drawn_error(design: Design, training: Training, key: PRNGKeyArray) -> Float[Array, ""]:
    """`end_to_end_error` with other noise at every key: for a stochastic search."""
    noise = jax.random.normal(key, training.noise.shape, training.noise.dtype)
    return end_to_end_error(design, eqx.tree_at(lambda t: t.noise, training, noise))


def restore(design: Design, training: Training) -> Float[Array, "image v u"]:
    """The restored images; NaN where conjugate gradients did not reach the tolerance."""
    return restore_by(channels_of(design, training), training)


def restore_by(cameras: tuple[Channel, ...], training: Training) -> Float[Array, "image v u"]:
    """The same by cameras of any kind, one for each row of the training's synthesis."""

    def one(image, noise):
        measured = [c.capture(image, n) for c, n in zip(cameras, noise, strict=True)]
        return _estimate(cameras, measured, training)

    return jax.vmap(one)(training.images, training.noise)


def _estimate(cameras, measured, training: Training) -> Float[Array, "v u"]:
    """The best linear estimate from (capture, variance) of each channel."""
    image = training.images[0]
    root = _prior_root(training)

    def shaped(x):
        return jnp.fft.irfft2(jnp.fft.rfft2(x) * as_complex(root), s=x.shape)

    def back(captures):
        total = jnp.zeros_like(image)
        for camera, capture in zip(cameras, captures, strict=True):
            total = total + jax.linear_transpose(camera, image)(capture)[0]
        return total

    def normal(z):
        seen = [camera(shaped(z)) / v for camera, (_, v) in zip(cameras, measured, strict=True)]
        return z + shaped(back(seen))

    right = shaped(back([g / v for g, v in measured]))

    solver = training.solver

    def solve(matrix, b):
        found, _ = cg(matrix, b, tol=solver.tolerance, maxiter=solver.steps)
        left = jnp.linalg.norm(matrix(found) - b)
        # The residual that is carried along is not quite this one.
        return jnp.where(left <= 2 * solver.tolerance * jnp.linalg.norm(b), found, jnp.nan)

    return shaped(jax.lax.custom_linear_solve(normal, right, solve, symmetric=True))


def _prior_root(training: Training) -> Float[Array, "v u"]:
    """Square root of the prior's power of each frequency of the image, per sample."""
    setup, count = training.setup, training.images.shape[-1]
    step = 1 / setup.field
    v = np.fft.fftfreq(count)[:, None] * count
    u = np.fft.rfftfreq(count) * count
    squared = jnp.asarray(v**2 + u**2, training.images.dtype) * step**2
    power = setup.prior(squared, setup.field)
    both = jnp.asarray(np.where((u == 0) | (2 * u == count), 1.0, 2.0), power.dtype)
    mean = jnp.sum(power * both) / count**2
    # The mean of an image is 1, and as uncertain as the rest.
    return jnp.sqrt(power / mean) * setup.contrast
