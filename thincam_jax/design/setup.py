r"""What a design is judged in: sensor, scene and noise."""

import equinox as eqx
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.module import Module
from thincam_jax.design.prior import PowerLaw


class SignalNoise(Module):
    """Gaussian noise at a signal-to-noise ratio, whatever the light.

    - `snr_db`: ratio of the capture's variance over the sensor to the noise's, dB. Dividing the
      exposure among captures does not change it.
    """

    snr_db: Float[Array, ""]

    def __init__(self, snr_db: Number = 30.0):
        self.snr_db = checks.finite("snr_db", snr_db, "dB")

    def variance(self, light: Numbers, signal: Numbers, exposure: Numbers):
        """Of a pixel, mm⁴: from the capture's mean (mm²), its variance, the share of exposure."""
        return signal * 10 ** (-self.snr_db / 10)


class PhotonNoise(Module):
    """Shot noise of the design's own light, and read noise.

    - `electrons`: of a pixel, from each mm² of open aperture, in an exposure of one share
      (`Design.exposure`): what the mask lets through is the design's own.
    - `read_noise`: standard deviation, electrons, of each capture.
    """

    electrons: Float[Array, ""]
    read_noise: Float[Array, ""]

    def __init__(self, electrons: Number = 2_000.0, read_noise: Number = 8.0):
        self.electrons = checks.positive("electrons", electrons, "electrons")
        self.read_noise = checks.non_negative("read_noise", read_noise, "electrons")

    def variance(self, light: Numbers, signal: Numbers, exposure: Numbers):
        """Of a pixel, mm⁴: from the capture's mean (mm²), its variance, the share of exposure."""
        counted = self.electrons * exposure
        return light / counted + (self.read_noise / counted) ** 2


class Setup(Module):
    """A sensor before a scene of mean 1 and the variance `contrast`².

    - `pitch`: of the sensor's pixels, mm; `sensor_width`: mm.
    - `object_distance`: t, mm; `object_width`: mm.
    - `noise`: `SignalNoise` or `PhotonNoise`.
    - `prior`: the scene's spectrum.
    - `contrast`: standard deviation of the scene over its mean.
    - `pixel_integration`: average over the pixels' area.
    - `crop`: count what the sensor does not see of an object's shadow; see
      `thincam_jax.design.response`.
    """

    pitch: Float[Array, ""]
    sensor_width: Float[Array, ""]
    object_distance: Float[Array, ""]
    object_width: Float[Array, ""]
    contrast: Float[Array, ""]
    noise: SignalNoise | PhotonNoise
    prior: PowerLaw
    pixel_integration: bool = eqx.field(static=True)
    crop: bool = eqx.field(static=True)

    def __init__(
        self,
        *,
        pitch: Number,
        sensor_width: Number,
        object_distance: Number,
        object_width: Number,
        noise: SignalNoise | PhotonNoise | None = None,
        prior: PowerLaw | None = None,
        contrast: Number = 0.5,
        pixel_integration: bool = True,
        crop: bool = True,
    ):
        self.pitch = checks.positive("pitch", pitch, "mm")
        self.sensor_width = checks.positive("sensor_width", sensor_width, "mm")
        self.object_distance = checks.positive("object_distance", object_distance, "mm")
        self.object_width = checks.positive("object_width", object_width, "mm")
        self.contrast = checks.positive("contrast", contrast, "parts of the mean")
        self.noise = SignalNoise() if noise is None else noise
        self.prior = PowerLaw() if prior is None else prior
        self.pixel_integration = pixel_integration
        self.crop = crop

    @property
    def field(self) -> Float[Array, ""]:
        """Width of the object as seen from the mask, rad (small angles)."""
        return self.object_width / self.object_distance
