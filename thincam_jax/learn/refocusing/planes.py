r"""A stack of planes, as the sensor sees it.

.. math:: \Delta F_k = \frac{P_k H_k^*}{\sum_j P_j |H_j|^2 + \eta}\, R

is the least-squares estimate of images with the power spectra P_k from R = Σ H_k F_k + noise of the
spectrum η. In half-quadratic splitting it is the exact solution of the step that ties the planes to
the data, with 1/P_k in place of its penalty. P_k and η are learnt.
"""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from thincam_jax._core.checks import Number
from thincam_jax._core.precision import squared_modulus
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import cut, place
from thincam_jax.learn.refocusing.cameras import RefocusCamera


class Planes(eqx.Module):
    """Planes at any distance, by their exact PSFs.

    Images and captures are in units in which both are about 1: a capture is divided by the light
    that a uniform scene of radiance 1 sends on average, `unit`.

    - `camera`: camera before which they stand.
    - `operator`: from the image (y, x) of the plane in the middle of the range to the capture.
    - `uniform`: its capture where its radiance is 1 everywhere.
    """

    camera: RefocusCamera
    operator: CropConvolution
    uniform: Float[Array, "y x"]

    def __init__(self, camera: RefocusCamera):
        self.camera = camera
        self.operator = camera.operator(camera.middle[None])
        self.uniform = self.operator(jnp.ones((1, *camera.field_shape), self.dtype))

    @property
    def dtype(self):
        return self.camera.camera.distance.dtype

    @property
    def window(self) -> tuple[int, int]:
        """Pixels of the transforms."""
        return self.operator.window

    @property
    def unit(self) -> Float[Array, ""]:
        """Root mean square of the transfer function; spectra are divided by it."""
        return jnp.sqrt(self.operator.mean_power())

    def spectra_at(self, distances: Float[Array, " plane"]) -> Complex[Array, "plane v u"]:
        """Transfer functions of any distances, mm, from exact PSFs, 1 in the root mean square."""
        spectra = self.camera.operator(distances).spectrum
        return spectra / self.unit.astype(spectra.dtype)

    def mean(self, capture: Float[Array, "y x"]) -> Float[Array, ""]:
        """The scene's mean radiance, by least squares as if it were uniform."""
        return jnp.sum(capture * self.uniform) / jnp.sum(self.uniform**2)

    def seen(self, spectrum: Complex[Array, "v u"]) -> Float[Array, "y x"]:
        """Capture of an image on the window, given by its spectrum."""
        image = jnp.fft.irfft2(spectrum, s=self.window)
        return cut(image, self.operator.sensor_corner, self.operator.sensor_shape)

    def from_sensor(self, capture: Float[Array, "y x"]) -> Float[Array, "v u"]:
        """A capture on a window of zeros."""
        return place(capture, self.operator.sensor_corner, self.window)

    def on_field(self, spectrum: Complex[Array, "*planes v u"]) -> Float[Array, "*planes y x"]:
        """The field's part of images given by their spectra."""
        images = jnp.fft.irfft2(spectrum, s=self.window)
        return cut(images, self.operator.field_corner, self.operator.field_shape)

    def from_field(self, images: Float[Array, "*planes y x"]) -> Complex[Array, "*planes v u"]:
        """Spectra of images that are dark beside the field."""
        return jnp.fft.rfft2(place(images, self.operator.field_corner, self.window))


class LinearStep(eqx.Module):
    """Learnt powers P_k(ρ) = p_k/(ρ² + ρ₀²)^γ, ρ₀ one cycle over the field, and noise.

    The fraction has the mean 1 over all frequencies.

    - `power`: ln p, of scenes of mean radiance 1, of each place where a plane may stand.
    - `slope`: γ; photographs have about 1, what is left of them after a few steps less.
    - `noise`: two logarithms: of a factor on the power of the noise, and of a power added to it
      for what the model leaves out.
    """

    power: Float[Array, " place"]
    slope: Float[Array, ""]
    noise: Float[Array, "2"]

    def __init__(
        self, places: int, *, power: float = 0.3, slope: Number = 1.0, noise: Number = 1.0
    ):
        self.power = jnp.full(places, np.log(power / places))
        self.slope = jnp.asarray(slope)
        self.noise = jnp.log(jnp.asarray([noise, 1e-4]))

    def __call__(
        self,
        residual: Complex[Array, "v u"],
        spectra: Complex[Array, "plane v u"],
        variance: Float[Array, ""],
        planes: Planes,
        place: Float[Array, "place plane"] | None = None,
    ) -> Complex[Array, "plane v u"]:
        """Correction of the planes' spectra for a residual of the capture.

        `variance`: variance of the residual's noise per sensor pixel, in the units of the residual;
        `place`: 1 where a plane stands, default each at its own.
        """
        dtype = variance.dtype
        window, field = planes.window, planes.operator.field_shape
        v, u = np.fft.fftfreq(window[0]), np.fft.rfftfreq(window[1])
        squared, corner = v[:, None] ** 2 + u**2, 1 / max(field) ** 2  # ρ², ρ₀²
        shape = (jnp.asarray(squared, dtype) + corner) ** -self.slope.astype(dtype)
        shape = shape / _mean(shape, window)
        power = jnp.exp(self.power.astype(dtype))
        power = (power if place is None else power @ place)[:, None, None] * shape
        factor, model = jnp.exp(self.noise.astype(dtype))
        # Sums of squares of the transforms: of white noise on the sensor, of an image on the field.
        pixels = math.prod(planes.operator.sensor_shape)
        ratio = (factor * variance + model) * pixels / math.prod(field)
        total = jnp.sum(power * squared_modulus(spectra), axis=0) + ratio
        filtered = residual * (1 / total).astype(residual.dtype)
        return spectra.conj() * filtered * power.astype(residual.dtype)


def _mean(spectrum: Float[Array, "v u"], window: tuple[int, int]) -> Float[Array, ""]:
    """Mean over all frequencies of a real image's spectrum, given for u ≥ 0 as by `rfft2`."""
    weights = np.full(spectrum.shape[-1], 2.0)
    weights[0] = 1.0
    if window[1] % 2 == 0:
        weights[-1] = 1.0
    weights = jnp.asarray(weights / math.prod(window), spectrum.dtype)
    return jnp.sum(spectrum * weights)
