"""A stack of planes, as the sensor sees it."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

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
