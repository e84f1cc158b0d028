r"""The error of an actual reconstruction of training images, differentiated through the solver.

What the frequency-wise objectives leave out is all here: the sensor's crop, PSFs in closed form
with their edges, real images. Each image f on the object gives captures

.. math:: g_c = A_c f + n_c, \qquad A_c f = C\,(h_c * R_{d} f)

with R_d the projection onto the pixels of a sensor at the distance d, h_c the PSF of a sum of
captures and C the crop; and is restored as the best linear estimate under the prior η_f,

.. math:: \hat f = S z, \qquad
    \Big(1 + S \sum_c \frac{A_c^T A_c}{\sigma_c^2} S\Big) z
    = S \sum_c \frac{A_c^T g_c}{\sigma_c^2}, \qquad S = \eta_f^{1/2}

by conjugate gradients. Their derivative is taken implicitly, at the solution, by another solve.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax._phase import as_complex
from thincam_jax.camera import LenslessCamera
from thincam_jax.design.design import Design
from thincam_jax.design.setup import Setup
from thincam_jax.grids import Grid
from thincam_jax.operators import CropConvolution, kernel_grid
from thincam_jax.psf import psf
from thincam_jax.scene import ImagePlane
from thincam_jax.sensor import Sensor


class Training(eqx.Module):
    """Images to restore, and the noise that their captures are given.

    - `images`: (image, v, u), square, over the object's width, of mean 1.
    - `noise`: standard normal numbers (image, channel, y, x): the same in every evaluation, so that
      the objective is smooth; draw others from step to step for a stochastic search.
    - `setup`: the noise's shape divides its `sensor_width` into pixels; its `pitch` is not used.
    - `synthesis`: rows (channel) of weights of the captures; a row adds captures at one distance.
    - `field_shape`: of the projection on the sensor, at least the object's at the longest distance.
    - `tolerance`, `steps`: of conjugate gradients: relative residual, and at most so many.
    """

    images: Float[Array, "image v u"]
    noise: Float[Array, "image channel y x"]
    setup: Setup
    synthesis: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    field_shape: tuple[int, int] = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)
    steps: int = eqx.field(static=True)

    def __init__(
        self,
        images: Float[Array, "image v u"] | Float[np.ndarray, "image v u"],
        setup: Setup,
        synthesis: Float[np.ndarray, "channel capture"],
        *,
        sensor_shape: tuple[int, int],
        longest_distance,
        key: PRNGKeyArray,
        tolerance: float = 1e-4,
        steps: int = 200,
    ):
        given = jnp.asarray(images, float)
        if given.ndim != 3 or given.shape[-1] != given.shape[-2]:
            raise ValueError(f"images have shape {given.shape}; give (image, n, n), square ones")
        self.images = given / jnp.mean(given, axis=(-2, -1), keepdims=True)
        rows = np.asarray(synthesis, dtype=float)
        if rows.ndim != 2 or not np.any(rows, axis=1).all():
            raise ValueError(
                f"synthesis has shape {rows.shape}; give (channel, capture) without rows of zeros"
            )
        self.synthesis = tuple(map(tuple, rows.tolist()))
        shape = (len(given), len(rows), *sensor_shape)
        self.noise = jax.random.normal(key, shape, self.images.dtype)
        self.setup = setup
        pixels = float(setup.field * longest_distance / setup.sensor_width) * max(sensor_shape)
        # Both ends of the projection, and the parity of the sensor, so that their centres agree.
        rows, columns = (math.ceil(pixels) + 2 + (math.ceil(pixels) + n) % 2 for n in sensor_shape)
        self.field_shape = (rows, columns)
        self.tolerance, self.steps = tolerance, steps

    @property
    def sensor(self) -> Sensor:
        """As many pixels as there is noise for."""
        rows, columns = self.noise.shape[-2:]
        return Sensor((rows, columns), self.setup.sensor_width / max(rows, columns))


def end_to_end_error(design: Design, training: Training) -> Float[Array, ""]:
    """Squared error of the restored images, as a part of their variance, averaged.

    The PSNR in dB is −10·log₁₀ of this, up to a constant of the images. NaN where conjugate
    gradients did not reach the tolerance.
    """
    restored = restore(design, training)
    error = jnp.mean((restored - training.images) ** 2, axis=(-2, -1))
    return jnp.mean(error / jnp.var(training.images, axis=(-2, -1)))


def drawn_error(design: Design, training: Training, key: PRNGKeyArray) -> Float[Array, ""]:
    """`end_to_end_error` with other noise at every key: for a stochastic search."""
    noise = jax.random.normal(key, training.noise.shape, training.noise.dtype)
    return end_to_end_error(design, eqx.tree_at(lambda t: t.noise, training, noise))


def restore(design: Design, training: Training) -> Float[Array, "image v u"]:
    """The restored images; NaN where conjugate gradients did not reach the tolerance."""
    rows = np.asarray(training.synthesis)
    if rows.shape[1] != design.captures:
        raise ValueError(
            f"the synthesis adds {rows.shape[1]} captures and the design takes {design.captures}; "
            "make them the same"
        )
    kernels = _kernels(design, training)
    cameras = tuple(_Channel(design, training, kernels, row) for row in rows)

    def one(image, noise):
        measured = [c.capture(image, n) for c, n in zip(cameras, noise, strict=True)]
        return _estimate(cameras, measured, training)

    return jax.vmap(one)(training.images, training.noise)


class _Channel(eqx.Module):
    """A sum of captures at one distance: A_c."""

    captures: tuple[CropConvolution, ...]
    summed: CropConvolution
    exposure: tuple[Float[Array, ""], ...]
    distance: Float[Array, ""]
    grid: Grid
    setup: Setup
    weights: tuple[float, ...] = eqx.field(static=True)

    def __init__(
        self,
        design: Design,
        training: Training,
        kernels: Float[Array, "capture k l"],
        row: Float[np.ndarray, " capture"],
    ):
        used = [int(k) for k in np.flatnonzero(row)]
        self.weights = tuple(float(row[k]) for k in used)
        self.distance = design.distance[used[0]]
        self.exposure = tuple(design.exposure[k] for k in used)
        self.setup = training.setup
        sensor, field = training.sensor, training.field_shape
        self.grid = Grid(field, sensor.pitch)
        whole = jnp.tensordot(jnp.asarray(row, kernels.dtype), kernels, axes=1)

        def convolution(kernel):
            return CropConvolution(kernel, sensor.pitch, sensor.shape, field)

        self.captures = tuple(convolution(kernels[k]) for k in used)
        self.summed = convolution(whole)

    def __call__(self, image: Float[Array, "v u"]) -> Float[Array, "y x"]:
        return self.summed(self._projected(image))

    def capture(self, image, noise) -> tuple[Float[Array, "y x"], Float[Array, ""]]:
        """The sum of the noisy captures, and the variance of its noise."""
        projected = self._projected(image)
        variance = jnp.zeros((), image.dtype)
        for weight, own, exposure in zip(self.weights, self.captures, self.exposure, strict=True):
            clean = own(projected)
            each = self.setup.noise.variance(jnp.mean(clean), jnp.var(clean), exposure)
            variance = variance + weight**2 * each
        return self.summed(projected) + jnp.sqrt(variance) * noise, variance

    def _projected(self, image):
        plane = ImagePlane(image, self.setup.object_distance, self.setup.object_width)
        # Upright: masks are symmetric, and the image comes back the way it went in.
        return plane.sample(self.grid, magnification=self.distance / self.setup.object_distance)


def _kernels(design: Design, training: Training) -> Float[Array, "capture k l"]:
    """The PSF of every capture, in one program."""
    sensor, there = training.sensor, training.setup.object_distance

    def kernel(beta, phase, distance, wavelength):
        return psf(
            LenslessCamera(design.mask(beta, phase), sensor, distance),
            wavelength=wavelength,
            object_distance=there,  # pyright: ignore[reportArgumentType]
            grid=kernel_grid(sensor.grid, training.field_shape),
            pixel_integration=training.setup.pixel_integration,
        )

    return jax.vmap(kernel)(design.beta, design.phase, design.distance, design.wavelength)


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

    def solve(matrix, b):
        found, _ = cg(matrix, b, tol=training.tolerance, maxiter=training.steps)
        left = jnp.linalg.norm(matrix(found) - b)
        # The residual that is carried along is not quite this one.
        return jnp.where(left <= 2 * training.tolerance * jnp.linalg.norm(b), found, jnp.nan)

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
