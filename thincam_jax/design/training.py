r"""Images to train a design on, and their captures by it, differentiable in all its numbers.

Each image f on the object gives captures

.. math:: g_c = A_c f + n_c, \qquad A_c f = C\,(h_c * R_{d} f)

with R_d the projection onto the pixels of a sensor at the distance d, h_c the PSF of a sum of
captures and C the crop. `end_to_end` and `wiener` restore the images.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax._core import checks
from thincam_jax._core.checks import Number
from thincam_jax._core.grids import Grid
from thincam_jax.design.design import Design
from thincam_jax.design.setup import Setup
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import kernel_grid
from thincam_jax.imaging.scene import ImagePlane
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.psf import psf


@dataclass(frozen=True)
class Window:
    """A square of angles, and its samples: what a discrete spectrum of the scene belongs to.

    - `angle`: its side, rad: the sensor as seen through the mask at the shortest distance, and the
      object beside it, so that nothing wraps round.
    - `samples`: along it, as fine as the pixels at the longest distance.
    - `across`: number of samples over the sensor's width, at that distance.
    """

    angle: float
    samples: int
    across: float


@dataclass(frozen=True)
class TrainedSensor:
    """A sensor in training, and where designs may place it.

    - `shape`: rows and columns of pixels, as many as there is noise for.
    - `distances`: the shortest and the longest from the mask, mm.
    """

    shape: tuple[int, int]
    distances: tuple[float, float]

    def __post_init__(self):
        if not 0 < self.distances[0] <= self.distances[1]:
            raise ValueError(
                f"distances = {self.distances} mm; give the shortest and the longest, > 0"
            )


@dataclass(frozen=True)
class ConjugateGradients:
    """End of conjugate gradients: at a relative residual, or after so many steps."""

    tolerance: float = 1e-4
    steps: int = 200


def _window(setup: Setup, pixels: int, shortest: float, longest: float) -> Window:
    width = float(setup.sensor_width)
    angle = width / shortest + float(setup.field)
    count = 2 * math.ceil(angle * longest * pixels / width / 2)
    return Window(angle, count, count * width / longest / angle)


class Training(eqx.Module):
    """Images to restore, and the noise that their captures are given.

    **Validity.** Of a design nearer than the shortest, light wraps round; of one farther than the
    longest, the field is cut off: both are refused where the distances are known numbers.

    **Errors**: ValueError for images that are not square or have no contrast, and for a synthesis
    with rows of zeros.

    - `images`: (image, v, u), square, over the object's width, of mean 1.
    - `noise`: standard normal numbers (image, channel, y, x): the same in every evaluation, so that
      the objective is smooth; draw others from step to step for a stochastic search.
    - `setup`: the noise's shape divides its `sensor_width` into pixels, larger ones than those of
      its `pitch`; noise is averaged over them.
    - `synthesis`: rows (channel) of weights of the captures; a row adds captures at one distance.
    - `field_shape`: samples of the projection on the sensor, at least the object's at the longest
      distance.
    - `distances`: mm; `window`: angles that a reconstruction's spectrum is taken over.
    - `solver`: solver of `end_to_end`; `denoiser`: a function of images and their noise's
      deviation, with which images are restored by plug and play, see `with_denoiser`.
    """

    images: Float[Array, "image v u"]
    noise: Float[Array, "image channel y x"]
    setup: Setup
    synthesis: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    field_shape: tuple[int, int] = eqx.field(static=True)
    distances: tuple[float, float] = eqx.field(static=True)
    window: Window = eqx.field(static=True)
    solver: ConjugateGradients = eqx.field(static=True)
    denoiser: Any

    def __init__(
        self,
        images: Float[Array, "image v u"] | Float[np.ndarray, "image v u"],
        setup: Setup,
        synthesis: Float[np.ndarray, "channel capture"],
        sensor: TrainedSensor,
        *,
        key: PRNGKeyArray,
        solver: ConjugateGradients = ConjugateGradients(),
    ):
        sensor_shape, distances = sensor.shape, sensor.distances
        given = jnp.asarray(images, float)
        if given.ndim != 3 or given.shape[-1] != given.shape[-2]:
            raise ValueError(f"images have shape {given.shape}; give (image, n, n), square ones")
        if not checks.is_traced(given) and not np.all(np.ptp(np.asarray(given), axis=(1, 2)) > 0):
            raise ValueError("an image has no contrast, or is not finite; there is nothing to see")
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
        pixels = float(setup.field * distances[1] / setup.sensor_width) * max(sensor_shape)
        # Both ends of the projection, and the parity of the sensor, so that their centres agree.
        rows, columns = (math.ceil(pixels) + 2 + (math.ceil(pixels) + n) % 2 for n in sensor_shape)
        self.field_shape = (rows, columns)
        self.distances = (float(distances[0]), float(distances[1]))
        self.window = _window(setup, max(sensor_shape), *distances)
        self.solver, self.denoiser = solver, None

    def with_denoiser(self, denoiser: Any) -> "Training":
        """The training whose images are restored with a denoiser, such as `learn.Denoiser()`."""
        return eqx.tree_at(lambda t: t.denoiser, self, denoiser, is_leaf=lambda x: x is None)

    @property
    def sensor(self) -> Sensor:
        """Sensor of as many pixels as there is noise for."""
        rows, columns = self.noise.shape[-2:]
        return Sensor((rows, columns), self.setup.sensor_width / max(rows, columns))


def relative_error(restored: Float[Array, "image v u"], training: Training) -> Float[Array, ""]:
    """Mean squared error of restored images over their variance, averaged over them."""
    error = jnp.mean((restored - training.images) ** 2, axis=(-2, -1))
    return jnp.mean(error / jnp.var(training.images, axis=(-2, -1)))


class CaptureSum(eqx.Module):
    """A sum of captures at one distance: A_c.

    - `kernels`: their PSFs, on `kernel_grid(training.sensor.grid, training.field_shape)`.
    - `weights`, `exposure`: weight and exposure of each capture; `distance`: mask to sensor, mm.
    """

    captures: tuple[CropConvolution, ...]
    summed: CropConvolution
    exposure: tuple[Float[Array, ""], ...]
    distance: Float[Array, ""]
    grid: Grid
    setup: Setup
    weights: tuple[float, ...] = eqx.field(static=True)

    def __init__(
        self,
        kernels: Float[Array, "capture k l"],
        weights: tuple[float, ...],
        exposure: tuple[Float[Array, ""], ...],
        distance: Float[Array, ""],
        training: Training,
    ):
        self.weights, self.exposure, self.distance = weights, exposure, distance
        self.setup = training.setup
        sensor, field = training.sensor, training.field_shape
        self.grid = Grid(field, sensor.pitch)

        def convolution(kernel):
            return CropConvolution(kernel, sensor.pitch, sensor.shape, field)

        self.captures = tuple(map(convolution, kernels))
        whole = jnp.tensordot(
            jnp.asarray(weights, kernels.dtype), kernels, axes=1, precision="highest"
        )
        self.summed = convolution(whole)

    def __call__(self, image: Float[Array, "v u"]) -> Float[Array, "y x"]:
        return self.summed(self._projected(image))

    def capture(
        self, image: Float[Array, "v u"], noise: Float[Array, "y x"]
    ) -> tuple[Float[Array, "y x"], Float[Array, ""]]:
        """The sum of the noisy captures, and the variance of its noise."""
        projected = self._projected(image)
        clean = [own(projected) for own in self.captures]
        variance = noise_variance(clean, self.weights, self.exposure, self.setup, self.grid.pitch)
        return self.summed(projected) + jnp.sqrt(variance) * noise, variance

    def _projected(self, image):
        plane = ImagePlane(image, self.setup.object_distance, self.setup.object_width)
        # Upright: masks are symmetric, and the image comes back the way it went in.
        return plane.sample(self.grid, magnification=self.distance / self.setup.object_distance)


def noise_variance(
    clean: Sequence[Float[Array, "y x"]],
    weights: Sequence[float],
    exposure: Sequence[Float[Array, ""]],
    setup: Setup,
    pitch: Number,
) -> Float[Array, ""]:
    """Noise variance of a pixel, `pitch` (mm) wide, of a sum of captures, `clean` without noise."""
    variance = jnp.zeros((), clean[0].dtype)
    for capture, weight, share in zip(clean, weights, exposure, strict=True):
        each = setup.noise.variance(jnp.mean(capture), jnp.var(capture), share)
        variance = variance + weight**2 * each
    # Pixels that stand for several of the sensor's have the mean of their noise.
    return variance * (setup.pitch / pitch) ** 2


def check_captures(design: Design, training: Training) -> None:
    """ValueError if the synthesis is for other captures, or a distance is out of the training's."""
    count = len(training.synthesis[0])
    if count != design.captures:
        raise ValueError(
            f"the synthesis adds {count} captures and the design takes {design.captures}; "
            "make them the same"
        )
    if checks.is_traced(design.distance):
        return
    shortest, longest = training.distances
    for distance in np.asarray(design.distance):
        if not shortest * (1 - 1e-5) <= distance <= longest * (1 + 1e-5):
            raise ValueError(
                f"distance = {distance:g} mm, and the training was made for {shortest:g} to "
                f"{longest:g} mm; make one with other distances"
            )


def channels_of(design: Design, training: Training) -> tuple[CaptureSum, ...]:
    """The sums of captures that the training's synthesis asks for."""
    check_captures(design, training)
    kernels = _kernels(design, training)

    def channel(row):
        used = np.flatnonzero(row)
        weights, exposure = tuple(row[k] for k in used), tuple(design.exposure[k] for k in used)
        return CaptureSum(kernels[used], weights, exposure, design.distance[used[0]], training)

    return tuple(channel(row) for row in training.synthesis)


def _kernels(design: Design, training: Training) -> Float[Array, "capture k l"]:
    """The PSF of every capture, in one program."""
    grid = kernel_grid(training.sensor.grid, training.field_shape)
    sensor, there = Sensor(grid.shape, grid.pitch), training.setup.object_distance

    def kernel(beta, phase, distance, wavelength):
        camera = LenslessCamera(design.mask(beta, phase), sensor, distance)
        light = {"wavelength": wavelength, "object_distance": there}
        return psf(camera, **light, pixel_integration=training.setup.pixel_integration)

    return jax.vmap(kernel)(design.beta, design.phase, design.distance, design.wavelength)
