r"""The error of the best linear estimate of training images, differentiated through the solver.

What the frequency-wise objectives leave out is all here: the sensor's crop, PSFs in closed form
with their edges, real images. Their captures g_c (`thincam_jax.design.training`), of noise σ_c²,
are restored as the best linear estimate under the prior η_f,

.. math:: \hat f = S z, \qquad
    \Big(1 + S \sum_c \frac{A_c^T A_c}{\sigma_c^2} S\Big) z
    = S \sum_c \frac{A_c^T g_c}{\sigma_c^2}, \qquad S = \eta_f^{1/2}

by conjugate gradients, preconditioned by the mean of AᵀA/σ² over rings of frequencies, which white
noise shows. Their derivative is taken implicitly, at the solution, by another solve.

With a denoiser D that estimate is the start of plug and play, much as that of
`thincam_jax.PlugAndPlay`: with a deviation s of the prior that falls in four steps,

.. math:: \hat f \leftarrow D(z, s/2), \qquad
    \Big(\sum_c \frac{A_c^T A_c}{\sigma_c^2} + \frac1{s^2}\Big) z
    = \sum_c \frac{A_c^T g_c}{\sigma_c^2} + \frac{\hat f}{s^2}

and a last z with half of the denoiser's σ as s. All steps are differentiated.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Float

from thincam_jax._core.precision import as_complex, squared_modulus
from thincam_jax.design.design import Design
from thincam_jax.design.training import CaptureSum, Training, channels_of, relative_error
from thincam_jax.reconstruction.problem import brightness

Image = Float[Array, "v u"]

# s over the brightness of an image; the last data step has a quarter of the last of these.
_DEVIATIONS = (1 / 6, 1 / 10, 1 / 15, 1 / 24)


def end_to_end_error(design: Design, training: Training) -> Float[Array, ""]:
    """Squared error of the restored images, as a part of their variance, averaged.

    With the training's denoiser, if it has one, of the images by plug and play.

    The PSNR in dB is −10·log₁₀ of this, up to a constant of the images. NaN where conjugate
    gradients ended above ten times the tolerance.
    """
    return relative_error(restore(design, training), training)


def restore(design: Design, training: Training) -> Float[Array, "image v u"]:
    """The restored images; NaN where conjugate gradients ended above ten times the tolerance."""
    return restore_by(channels_of(design, training), training)


def restore_by(cameras: tuple[CaptureSum, ...], training: Training) -> Float[Array, "image v u"]:
    """Images restored from captures of any cameras, one for each row of a training's synthesis."""

    def one(image, noise):
        measured = [c.capture(image, n) for c, n in zip(cameras, noise, strict=True)]
        captures = _Captures(cameras, measured, training)
        found = captures.linear_estimate()
        if training.denoiser is None:
            return found
        return captures.plug_and_play(found, training.denoiser, brightness(image))

    return jax.vmap(one)(training.images, training.noise)


class _Captures:
    """(capture, variance) of each camera, one image's."""

    def __init__(self, cameras: Sequence[CaptureSum], measured: Sequence[Any], training: Training):
        self.cameras, self.variances = cameras, [variance for _, variance in measured]
        self.training, self.image = training, training.images[0]
        self.right = self._back([capture for capture, _ in measured])
        self.powers = jax.lax.stop_gradient(self._mean_powers())

    def linear_estimate(self) -> Image:
        root = _prior_root(self.training)
        found = self._solved(
            lambda z: z + _filtered(root, self._normal(_filtered(root, z))),
            _filtered(root, self.right),
            root**2,
        )
        return _filtered(root, found)

    def plug_and_play(self, image: Image, denoiser: Callable, brightness: Array) -> Image:
        sigmas = [deviation / 2 * brightness for deviation in _DEVIATIONS]
        for sigma in sigmas:  # in a loop of XLA its convolutions take thirty times as long
            image = jnp.maximum(denoiser(self._data_step(image, 2 * sigma), sigma), 0)
        return jnp.maximum(self._data_step(image, sigmas[-1] / 2), 0)

    def _data_step(self, image: Image, s: Array) -> Image:
        # The change is solved for: it is small, and so is the error that its tolerance leaves.
        change = s**2 * (self.right - self._normal(image))
        return image + self._solved(lambda x: x + s**2 * self._normal(x), change, s**2)

    def _normal(self, image: Image) -> Image:
        return self._back([camera(image) for camera in self.cameras])

    def _back(self, captures: Sequence[Array]) -> Image:
        total = jnp.zeros_like(self.image)
        for camera, capture, v in zip(self.cameras, captures, self.variances, strict=True):
            total = total + jax.linear_transpose(camera, self.image)(capture / v)[0]
        return total

    def _mean_powers(self) -> Float[Array, "v u"]:
        """AᵀA/σ² at the frequencies of the image, a mean over rings of one cycle an image."""
        shape = self.image.shape
        noise = jax.random.normal(jax.random.key(0), shape, self.image.dtype)
        # Traced, since a camera refuses a known image that is negative.
        given, seen = jnp.fft.rfft2(noise), jnp.fft.rfft2(jax.jit(self._normal)(noise))
        v, u = np.fft.fftfreq(shape[0]) * shape[0], np.fft.rfftfreq(shape[1]) * shape[1]
        ring = np.rint(np.hypot(v[:, None], u)).astype(int)
        sums = jnp.zeros(ring.max() + 1, noise.dtype)
        power = sums.at[ring].add((given.conj() * seen).real)
        return (jnp.maximum(power, 0) / sums.at[ring].add(squared_modulus(given)))[ring]

    def _solved(self, matrix: Callable, right: Image, share: Array) -> Image:
        """The solution for 1 + AᵀA/σ² times a share of each frequency."""
        tolerance, steps = self.training.solver.tolerance, self.training.solver.steps
        inverse = jax.lax.stop_gradient(1 / (1 + share * self.powers))

        def solve(matrix, b):
            limit, about = tolerance * jnp.linalg.norm(b), functools.partial(_filtered, inverse)
            found, _ = cg(matrix, b, tol=tolerance, maxiter=steps, M=about)
            # In single precision the residual that is carried along may differ from this one,
            # and rounding may leave more than the limit.
            left = b - matrix(found)
            more, _ = cg(matrix, left, tol=0.0, atol=limit, maxiter=steps, M=about)
            left = jnp.linalg.norm(matrix(found + more) - b)
            return jnp.where(left <= 10 * limit, found + more, jnp.nan)

        return jax.lax.custom_linear_solve(matrix, right, solve, symmetric=True)


def _filtered(response: Array, image: Image) -> Image:
    return jnp.fft.irfft2(jnp.fft.rfft2(image) * as_complex(response), s=image.shape)


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
