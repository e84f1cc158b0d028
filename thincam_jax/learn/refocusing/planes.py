"""A stack of planes at fixed distances, as the sensor sees it."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import cut, place
from thincam_jax.learn.refocusing.cameras import RefocusCamera


class Planes(eqx.Module):
    """The exact spectra of the PSFs of a camera's planes, and those of any other distance.

    Images and captures are in units in which both are about 1: a capture is divided by the light
    that a uniform scene of radiance 1 sends on average, `unit`.

    - `camera`: what they are of.
    - `operator`: from the stack (plane, y, x) to the capture (y, x), both as the camera has them.
    - `uniform`: the capture of a uniform scene of radiance 1 in the middle plane.
    """

    camera: RefocusCamera
    operator: CropConvolution
    uniform: Float[Array, "y x"]

    def __init__(self, camera: RefocusCamera):
        self.camera = camera
        self.operator = camera.operator(1 / camera.inverse_distances)
        middle = jnp.zeros((camera.planes, *camera.field_shape), self.dtype)
        self.uniform = self.operator(middle.at[camera.planes // 2].set(1))

    @property
    def dtype(self):
        return self.camera.camera.distance.dtype

    @property
    def window(self) -> tuple[int, int]:
        """Pixels of the transforms."""
        return self.operator.window

    @property
    def unit(self) -> Float[Array, ""]:
        """Root mean square of the planes' transfer functions; spectra are divided by it."""
        return jnp.sqrt(self.operator.mean_power())

    @property
    def spectra(self) -> Complex[Array, "plane v u"]:
        """Transfer functions of the planes, 1 in the root mean square."""
        return self.operator.spectrum / self.unit.astype(self.operator.spectrum.dtype)

    def spectrum_at(self, distance: Float[Array, ""]) -> Complex[Array, "v u"]:
        """Transfer function of any distance, mm, from the exact PSF, in the same unit."""
        spectrum = self.camera.operator(distance[None]).spectrum[0]
        return spectrum / self.unit.astype(spectrum.dtype)

    def mean(self, capture: Float[Array, "y x"]) -> Float[Array, ""]:
        """The scene's mean radiance, by least squares as if it were uniform."""
        return jnp.sum(capture * self.uniform) / jnp.sum(self.uniform**2)

    def seen(self, spectrum: Complex[Array, "v u"]) -> Float[Array, "y x"]:
        """What the sensor sees of an image on the window, given by its spectrum."""
        return self.on_sensor(jnp.fft.irfft2(spectrum, s=self.window))

    def on_sensor(self, image: Float[Array, "v u"]) -> Float[Array, "y x"]:
        """The sensor's part of the window."""
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

    def splat(self, inverse_distance: Float[Array, "*map"]) -> Float[Array, "plane *map"]:
        """Weights of the planes in what stands at 1/t: linear in 1/t between neighbours, sum 1."""
        camera = self.camera
        inside = jnp.clip(inverse_distance, 1 / camera.far, 1 / camera.near)
        planes = camera.inverse_distances.reshape(-1, *(1,) * inside.ndim)
        return jnp.maximum(1 - jnp.abs(planes - inside) / camera.step, 0)
