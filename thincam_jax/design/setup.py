r"""What a design is judged in: sensor, scene and noise."""

import equinox as eqx
from jaxtyping import Array, Float

from thincam_jax._core.checks import Numbers
from thincam_jax._core.module import Module
from thincam_jax._core.quantity import quantity
from thincam_jax.design.prior import PowerLaw


class SignalNoise(Module):
    """Gaussian noise at a signal-to-noise ratio, whatever the light.

    - `snr_db`: ratio of the capture's variance over the sensor to the noise's, dB. Dividing the
      exposure among captures does not change it.
    """

    snr_db: Float[Array, ""] = eqx.field(default=30.0, converter=quantity("dB"))

    def variance(self, light: Numbers, signal: Numbers, exposure: Numbers):
        """Of a pixel, mm⁴: from the capture's mean (mm²), its variance, the share of exposure."""
        return signal * 10 ** (-self.snr_db / 10)


class PhotonNoise(Module):
    """Shot noise of the design's own light, and read noise.

    - `electrons`: of a pixel, from each mm² of open aperture, in an exposure of one share
      (`Design.exposure`): what the mask lets through is the design's own.
    - `read_noise`: standard deviation, electrons, of each capture.
    """

    electrons: Float[Array, ""] = eqx.field(
        default=2_000.0, converter=quantity("electrons", positive=True)
    )
    read_noise: Float[Array, ""] = eqx.field(
        default=8.0, converter=quantity("electrons", non_negative=True)
    )

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

    pitch: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    sensor_width: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    object_distance: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    object_width: Float[Array, ""] = eqx.field(converter=quantity("mm", positive=True))
    contrast: Float[Array, ""] = eqx.field(
        default=0.5, converter=quantity("parts of the mean", positive=True)
    )
    noise: SignalNoise | PhotonNoise = eqx.field(
        default=None, converter=lambda given: SignalNoise() if given is None else given
    )
    prior: PowerLaw = eqx.field(
        default=None, converter=lambda given: PowerLaw() if given is None else given
    )
    pixel_integration: bool = eqx.field(default=True, converter=bool, static=True)
    crop: bool = eqx.field(default=True, converter=bool, static=True)

    @property
    def field(self) -> Float[Array, ""]:
        """Width of the object as seen from the mask, rad (small angles)."""
        return self.object_width / self.object_distance
