"""The image sensor: pixels, noise, saturation and digitisation."""

import abc
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Shape
from thincam_jax._core.grids import Grid
from thincam_jax._core.module import Module

Pictures = Float[Array, "*batch y x"]
Electrons = Float[Array, "*batch 1 1"]  # per unit of each picture


class Sensor(Module):
    """A monochrome image sensor of square pixels that are sensitive over their whole area.

    - `shape`: (rows, columns).
    - `pitch`: pixel pitch, mm.
    - `full_well`: electrons that a pixel holds.
    - `exposure`: the brightest noise-free pixel as a part of the full well; above 1 it saturates.
      None is an ideal sensor that never saturates.
    - `electrons`: in place of `exposure`, an exposure time that is the same for every image: so
      many electrons of a pixel from each mm² of open aperture, the unit of captures, before a
      white scene.
    - `bit_depth`: bits of the analogue-digital converter, whose range is the full well; None does
      not quantise. Needs an `exposure` or `electrons`.
    """

    shape: tuple[int, int] = eqx.field(static=True)
    pitch: Float[Array, ""]
    full_well: Float[Array, ""]
    exposure: Float[Array, ""] | None
    electrons: Float[Array, ""] | None
    bit_depth: int | None = eqx.field(static=True)

    def __init__(
        self,
        shape: Shape,
        pitch: Number,
        *,
        full_well: Number = 13_500.0,
        exposure: Number | None = None,
        electrons: Number | None = None,
        bit_depth: float | int | None = None,
    ):
        self.shape = checks.shape2d("shape", shape)
        self.pitch = checks.pixel_pitch("pitch", pitch)
        self.full_well = checks.positive("full_well", full_well, "electrons")
        if exposure is not None and electrons is not None:
            raise ValueError(
                "exposure and electrons both say how long the sensor is exposed; give one"
            )
        self.exposure = self.electrons = None
        if exposure is not None:
            self.exposure = checks.positive("exposure", exposure, "parts of the full well")
        if electrons is not None:
            self.electrons = checks.positive("electrons", electrons, "electrons from each mm²")
        if bit_depth is not None and (int(bit_depth) != bit_depth or not 1 <= bit_depth <= 24):
            raise ValueError(f"bit_depth = {bit_depth!r}: give a whole number from 1 to 24")
        if bit_depth is not None and exposure is None and electrons is None:
            raise ValueError("bit_depth needs an exposure: the converter's range is the full well")
        self.bit_depth = None if bit_depth is None else int(bit_depth)

    @property
    def grid(self) -> Grid:
        """The pixel centres."""
        return Grid(self.shape, self.pitch)


class AbstractNoise(Module):
    """Adds the randomness of a read-out to a noise-free image."""

    @abc.abstractmethod
    def add(self, key: PRNGKeyArray, image: Pictures, electrons: Electrons | None) -> Pictures:
        """The noisy image. `electrons` is the number per unit of the image; None if unknown."""

    @abc.abstractmethod
    def variance(
        self, image: Pictures, electrons: Electrons | None = None
    ) -> Float[Array, "*batch"]:
        """Noise variance of a pixel, averaged over each image, in the image's unit squared."""


class GaussianNoise(AbstractNoise):
    r"""White Gaussian noise at a signal-to-noise ratio, the same for every image of a batch.

    σ² = S·10^(−SNR/10), for each (y, x) image, where the signal power S is

    - "total": the mean of the squared image, its mean included (MATLAB's ``awgn(…, 'measured')``);
    - "without_mean": its variance: what is left of a lensless capture once its bias is removed.
    """

    snr_db: Float[Array, ""] = eqx.field(converter=checks.named(checks.finite, "snr_db", "dB"))
    signal_power: Literal["total", "without_mean"] = eqx.field(
        default="total",
        converter=checks.named(checks.choice, "signal_power", ("total", "without_mean")),
        static=True,
    )

    def variance(
        self, image: Pictures, electrons: Electrons | None = None
    ) -> Float[Array, "*batch"]:
        if self.signal_power == "total":
            power = jnp.mean(image**2, axis=(-2, -1))
        else:
            power = jnp.var(image, axis=(-2, -1))
        return power * 10 ** (-self.snr_db.astype(image.dtype) / 10)

    def add(self, key: PRNGKeyArray, image: Pictures, electrons: Electrons | None) -> Pictures:
        sigma = jnp.sqrt(self.variance(image))[..., None, None]
        return image + sigma * jax.random.normal(key, image.shape, image.dtype)


class PoissonGaussianNoise(AbstractNoise):
    """Shot noise of the photo-electrons and Gaussian read noise.

    - `read_noise`: standard deviation in electrons, ≥ 0.

    The number of electrons follows from the sensor's full well and exposure.
    """

    read_noise: Float[Array, ""] = eqx.field(
        default=8.0, converter=checks.named(checks.non_negative, "read_noise", "electrons")
    )

    def variance(
        self, image: Pictures, electrons: Electrons | None = None
    ) -> Float[Array, "*batch"]:
        if electrons is None:
            raise ValueError("PoissonGaussianNoise counts electrons: give their number")
        mean = jnp.mean(jnp.maximum(image * electrons, 0.0), axis=(-2, -1))
        read = self.read_noise.astype(image.dtype) ** 2
        return (mean + read) / electrons[..., 0, 0] ** 2

    def add(self, key: PRNGKeyArray, image: Pictures, electrons: Electrons | None) -> Pictures:
        if electrons is None:
            raise ValueError(
                "PoissonGaussianNoise counts electrons: give the Sensor an exposure, such as 0.9, "
                "or electrons"
            )
        shot_key, read_key = jax.random.split(key)
        mean = jnp.maximum(image * electrons, 0.0)
        counts = jax.random.poisson(shot_key, mean, dtype=jnp.int32).astype(image.dtype)
        read = self.read_noise.astype(image.dtype) * jax.random.normal(
            read_key, image.shape, image.dtype
        )
        return (counts + read) / electrons


def electrons_per_unit(sensor: Sensor, image: Pictures) -> Electrons | None:
    """Electrons per unit of each image at the sensor's exposure; None for an ideal sensor."""
    if sensor.electrons is not None:
        counted = sensor.electrons.astype(image.dtype)
        return jnp.broadcast_to(counted, (*image.shape[:-2], 1, 1))
    if sensor.exposure is None:
        return None
    brightest = jnp.max(image, axis=(-2, -1), keepdims=True)
    target = (sensor.exposure * sensor.full_well).astype(image.dtype)
    return target / jnp.where(brightest > 0, brightest, 1.0)


def read_out(
    sensor: Sensor, image: Pictures, *, noise: AbstractNoise | None = None, key: Any = None
) -> Pictures:
    """What the sensor reports for a noise-free image, in the image's own units.

    Noise, then saturation at the full well, then quantisation, as `sensor` and `noise` ask for.
    Every (y, x) image of a batch is exposed on its own.

    **Errors**: ValueError if noise is given without a key, TypeError for a number as key.
    """
    if noise is not None and key is None:
        raise ValueError("noise needs a key: pass key=jax.random.key(seed)")
    if noise is not None and not eqx.is_array(key):
        raise TypeError(f"key = {key!r} is no random key; pass key=jax.random.key({key!r})")
    return _read_out(sensor, image, noise, key)


@eqx.filter_jit
def _read_out(sensor: Sensor, image, noise: AbstractNoise | None, key):
    electrons = electrons_per_unit(sensor, image)
    if noise is not None and key is not None:
        image = noise.add(key, image, electrons)
    if electrons is None:
        return image
    full = sensor.full_well.astype(image.dtype) / electrons
    image = jnp.clip(image, 0.0, full)
    if sensor.bit_depth is not None:
        step = full / (2**sensor.bit_depth - 1)
        image = jnp.round(image / step) * step
    return image
