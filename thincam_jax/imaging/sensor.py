"""The image sensor: pixels, noise, saturation and digitisation."""

import abc
import functools
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax._core import checks
from thincam_jax._core.grids import Grid
from thincam_jax._core.module import Module
from thincam_jax._core.quantity import FieldError, choice, quantity, whole
from thincam_jax._core.random import random_key

Pictures = Float[Array, "*batch y x"]
Electrons = Float[Array, "*batch 1 1"]  # per unit of each picture


def _response(name: str, given: Any) -> Float[Array, "*table"]:
    """The check of an angular response: a power, or a table of angles and responses."""
    response = checks.array(name, given)
    if response.ndim == 0:
        return checks.non_negative(name, given, "a power of cos θ")
    if response.ndim != 2 or response.shape[-1] != 2 or len(response) < 2:
        raise ValueError(
            f"{name} has shape {response.shape}; give one number, n of cosⁿθ, or a table of two "
            "rows or more, (angle in rad, response)"
        )
    if checks.is_traced(response):
        return response
    angles, values = np.asarray(response).T
    if angles[0] != 0 or (np.diff(angles) <= 0).any() or not values.min() >= 0:
        raise ValueError(
            f"{name} is no table of responses >= 0 at angles that rise from 0; give rows of "
            "(angle in rad, response)"
        )
    return response


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
    - `angular_response`: response of the pixels, beside the cosine of their tilted area: n of
      cosⁿθ, or a table of rows (θ in rad, response) from θ = 0 on. It counts where captures have
      the light of every point of the field (`PsfMethod(field_tolerance=1.0)`, plans).
    - `bit_depth`: bits of the analogue-digital converter, whose range is the full well; None does
      not quantise. Needs an `exposure` or `electrons`.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import um

    sensor = tc.Sensor((24, 32), pitch=50 * um, full_well=10_000, exposure=0.9, bit_depth=12)
    print(sensor.grid.shape)  # (24, 32)
    ```

    **See also**: `LenslessCamera`, `PoissonGaussianNoise`.
    """

    shape: tuple[int, int] = eqx.field(converter=quantity(check=checks.shape2d), static=True)
    pitch: Float[Array, ""] = eqx.field(converter=quantity("mm", check=checks.pixel_pitch))
    full_well: Float[Array, ""] = eqx.field(
        default=13_500.0, converter=quantity("electrons", positive=True), kw_only=True
    )
    exposure: Float[Array, ""] | None = eqx.field(
        default=None,
        converter=quantity("parts of the full well", positive=True, optional=True),
        kw_only=True,
    )
    electrons: Float[Array, ""] | None = eqx.field(
        default=None,
        converter=quantity("electrons/mm^2", positive=True, optional=True),
        kw_only=True,
    )
    bit_depth: int | None = eqx.field(
        default=None, converter=whole(1, 24, optional=True), static=True, kw_only=True
    )
    angular_response: Float[Array, "*table"] | None = eqx.field(
        default=None, converter=quantity(check=_response, optional=True), kw_only=True
    )

    def __check_init__(self):
        if self.exposure is not None and self.electrons is not None:
            raise FieldError(
                "exposure and electrons both say how long the sensor is exposed; give one",
                "electrons",
            )
        if self.bit_depth is not None and not self.counts:
            raise FieldError(
                "bit_depth needs an exposure, such as 0.9, or electrons: the converter's range is "
                "the full well",
                "bit_depth",
            )

    @property
    def grid(self) -> Grid:
        """The pixel centres."""
        return Grid(self.shape, self.pitch)

    @property
    def counts(self) -> bool:
        """Whether it is known how many electrons a pixel holds."""
        return self.exposure is not None or self.electrons is not None


# Converter of attributes that are a sensor.
as_sensor = functools.partial(checks.instance, "sensor", Sensor, "a thincam_jax.Sensor")


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
    - "without_mean": its variance: the power of a lensless capture without its bias.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    scene = tc.Scene(tc.ImagePlane([[0.0, 1.0]], distance=250.0, width=40.0), 500 * nm)
    noisy = tc.capture(camera, scene, noise=tc.GaussianNoise(snr_db=30.0), key=0)
    ```

    **See also**: `PoissonGaussianNoise`, `capture`.
    """

    snr_db: Float[Array, ""] = eqx.field(converter=quantity("dB", check=checks.decibels))
    signal_power: Literal["total", "without_mean"] = eqx.field(
        default="total", converter=choice(("total", "without_mean")), static=True
    )

    def variance(
        self, image: Pictures, electrons: Electrons | None = None
    ) -> Float[Array, "*batch"]:
        return _gaussian_variance(self, image)

    def add(self, key: PRNGKeyArray, image: Pictures, electrons: Electrons | None) -> Pictures:
        sigma = jnp.sqrt(self.variance(image))[..., None, None]
        return image + sigma * jax.random.normal(key, image.shape, image.dtype)


@eqx.filter_jit
def _gaussian_variance(noise: GaussianNoise, image: Pictures) -> Float[Array, "*batch"]:
    if noise.signal_power == "total":
        power = jnp.mean(image**2, axis=(-2, -1))
    else:
        power = jnp.var(image, axis=(-2, -1))
    return power * 10 ** (-noise.snr_db.astype(image.dtype) / 10)


class PoissonGaussianNoise(AbstractNoise):
    """Shot noise of the photo-electrons and Gaussian read noise.

    - `read_noise`: standard deviation in electrons, ≥ 0.

    The number of electrons follows from the sensor's full well and exposure.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    sensor = tc.Sensor((24, 32), 50 * um, full_well=10_000, exposure=0.9)
    camera = tc.LenslessCamera(tc.FresnelZoneAperture(25.0, width=1.6), sensor, distance=5.0)
    scene = tc.Scene(tc.ImagePlane([[0.0, 1.0]], distance=250.0, width=40.0), 500 * nm)
    noisy = tc.capture(camera, scene, noise=tc.PoissonGaussianNoise(read_noise=8.0), key=0)
    ```

    **See also**: `GaussianNoise`, `Sensor`.
    """

    read_noise: Float[Array, ""] = eqx.field(
        default=8.0, converter=quantity("electrons", non_negative=True)
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
    """Reading of the sensor for a noise-free image, in the image's own units.

    Noise, then saturation at the full well, then quantisation, as `sensor` and `noise` ask for.
    Every (y, x) image of a batch is exposed on its own.

    **Errors**: ValueError if noise is given without a key.
    """
    if noise is not None and key is None:
        raise ValueError("noise needs a key: pass key=seed, such as key=0")
    return _read_out(sensor, image, noise, None if noise is None else random_key(key))


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
