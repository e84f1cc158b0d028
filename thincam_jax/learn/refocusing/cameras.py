"""The camera that a refocusing network belongs to, and the distances it is trained for."""

import math
from collections.abc import Sequence
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number, Numbers
from thincam_jax._core.grids import same_parity
from thincam_jax._core.quantity import FieldError, quantity, whole
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import kernel_shape
from thincam_jax.imaging.scene import Spectrum
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.method import MODELS, Model, PsfMethod
from thincam_jax.lensless.psf import spectral_psf

# Pixels that a PSF is kept beyond the mask's shadow: diffraction at its edge falls fast. For a zone
# aperture on pixels of 44 µm what is cut off is 1e-3 of the light at most (tests/learn).
_MARGIN = 8


class Stand(eqx.Module):
    """Distances of the planes of a stack, one of them at a commanded distance.

    - `inverse`: 1/t, 1/mm, the nearest first; `number`: index of the commanded plane.
    - `place`: 1 where a plane stands among the places relative to the commanded one, which is the
      middle one of 2·planes − 1; (place, plane).
    - `position`: place of the commanded distance in the range of 1/t, from −1, far, to 1, near.
    """

    inverse: Float[Array, " plane"]
    number: Int[Array, ""]
    place: Float[Array, "place plane"]
    position: Float[Array, ""]

    def splat(self, inverse_distance: Float[Array, "*map"]) -> Float[Array, "plane *map"]:
        """Weights of the planes in what stands at 1/t: linear in 1/t between neighbours, sum 1."""
        planes = self.inverse.reshape(-1, *(1,) * inverse_distance.ndim)
        inside = jnp.clip(inverse_distance, planes[-1], planes[0])
        part = (inside - planes[1:]) / (planes[:-1] - planes[1:])  # of the nearer of two
        part, beyond = jnp.clip(part, 0, 1), jnp.ones_like(part[:1])
        return jnp.concatenate([part, beyond]) - jnp.concatenate([0 * beyond, part])


@checked
class RefocusCamera(eqx.Module):
    """A camera, its light, its image and the range of its distances.

    - `camera`: mask, sensor and the distance d between them.
    - `light`: a `Spectrum` or one wavelength in mm.
    - `field_shape`: pixels (y, x) of the image, enlarged to the sensor's parity; pixel (i, j) looks
      along one ray through the middle of the mask, whatever the distance.
    - `near`, `far`: range of object distances t, mm.
    - `planes`: number of planes of a stack, evenly spaced in 1/t.
    - `pupil`: diameter D in mm of the lens that focused images are rendered for; default the width
      of the mask.
    - `model`: model of the PSFs, see `thincam_jax.psf`.

    The PSF is kept on `support` pixels, the mask's shadow from the nearest point with a margin; the
    widest lens blur reaches `largest_blur` pixels from its middle. Both are sizes, so that the
    camera is to be built outside of jit.

    **Errors**: ValueError or TypeError, one line, for what is out of range.
    """

    camera: LenslessCamera
    light: Spectrum
    near: Float[Array, ""]
    far: Float[Array, ""]
    pupil: Float[Array, ""]
    field_shape: tuple[int, int] = eqx.field(static=True)
    planes: int = eqx.field(static=True)
    model: Model = eqx.field(static=True)
    support: tuple[int, int] = eqx.field(static=True)
    largest_blur: int = eqx.field(static=True)

    def __init__(
        self,
        camera: LenslessCamera,
        light: Spectrum | Number,
        *,
        field_shape: tuple[int, int],
        near: Number,
        far: Number,
        planes: Annotated[int, whole(2, 64)] = 8,
        pupil: Annotated[Number | None, quantity("mm", positive=True, optional=True)] = None,
        model: Model = "separable",
    ):
        self.camera = camera
        self.light = light if isinstance(light, Spectrum) else Spectrum(light)
        dtype = camera.distance.dtype
        self.near = checks.positive("near", near, "mm").astype(dtype)
        self.far = checks.positive("far", far, "mm").astype(dtype)
        if not checks.is_traced(self.near) and not self.near < self.far:
            raise FieldError(f"near = {near} mm is not below far = {far} mm; swap them", "near")
        width = camera.mask.extent[1] if pupil is None else pupil
        self.pupil = checks.positive("pupil", width, "mm").astype(dtype)
        self.field_shape = same_parity(field_shape, camera.sensor.shape)
        self.planes = checks.whole("planes", planes, 2, 64)
        checks.choice("model", model, MODELS)
        self.model = model
        self.support = self._support()
        self.largest_blur = math.ceil(float(self.defocus_radius(1 / self.near - 1 / self.far)) + 1)

    @property
    def inverse_distances(self) -> Float[Array, " plane"]:
        """1/t of the planes, 1/mm, evenly spaced, the nearest first."""
        return jnp.linspace(1 / self.near, 1 / self.far, self.planes)

    @property
    def step(self) -> Float[Array, ""]:
        """Difference of 1/t between neighbouring planes, 1/mm."""
        return (1 / self.near - 1 / self.far) / (self.planes - 1)

    @property
    def middle(self) -> Float[Array, ""]:
        """The distance in the middle of the range of 1/t, mm."""
        return 2 / (1 / self.near + 1 / self.far)

    def stand(self, distance: Float[Array, ""]) -> Stand:
        """A stack with a plane at a distance, mm: evenly spaced planes, shifted there.

        Planes that would be shifted out of the range stand at its end.
        """
        even, commanded = self.inverse_distances, 1 / distance
        number = jnp.argmin(jnp.abs(even - commanded))
        shifted = even + (commanded - even[number])
        inverse = jnp.clip(shifted, 1 / self.far, 1 / self.near)
        count = self.planes
        places = jnp.arange(2 * count - 1)[:, None]
        place = (places == jnp.arange(count) - number + count - 1).astype(inverse.dtype)
        position = 2 * (commanded - 1 / self.middle) / (1 / self.near - 1 / self.far)
        return Stand(inverse, number, place, position)

    def defocus_radius(self, inverse_difference: Numbers) -> Float[Array, "..."]:
        """Radius, in pixels of the image, of the disc that a lens blurs a point to.

        A lens with the pupil D, focused on t′, blurs a point at t over the angle D|1/t − 1/t′|,
        that is over Dd|1/t − 1/t′|/p pixels of the pitch p/d.

        `inverse_difference`: 1/t − 1/t′, 1/mm.
        """
        pitch = self.camera.sensor.pitch
        return self.pupil * self.camera.distance / (2 * pitch) * jnp.abs(inverse_difference)

    def within(self, distances: Numbers | Sequence[Number]) -> Float[Array, "..."]:
        """Distances t, mm, that a network is trained for; ValueError for one outside."""
        distances = jnp.asarray(distances, self.near.dtype)
        if checks.is_traced(distances) or checks.is_traced(self.near):
            return distances
        near, far = float(self.near), float(self.far)
        for distance in distances.ravel().tolist():
            if not near * (1 - 1e-6) <= distance <= far * (1 + 1e-6):
                raise ValueError(
                    f"distance = {distance:g} mm lies outside of what the network was trained for, "
                    f"{near:g} to {far:g} mm; give one within, or train one for it"
                )
        return distances

    def operator(self, distances: Float[Array, " plane"]) -> CropConvolution:
        """The noise-free capture of planes (plane, y, x) at these distances, mm, summed.

        From the exact PSF of each, on its `support`; the distances may be traced.
        """
        pitch, shape = self.camera.sensor.pitch, self.camera.sensor.shape
        return CropConvolution(self.kernels(distances), pitch, shape, self.field_shape, summed=1)

    def kernels(self, distances: Float[Array, " plane"]) -> Float[Array, "plane k l"]:
        """The PSFs at these distances, mm, on `support` pixels."""
        grid = self.camera.sensor.grid.with_shape(self.support)
        method = PsfMethod(self.model, pixel_integration=True)
        light = self.light.colours
        return jax.vmap(lambda t: spectral_psf(self.camera, light, t, method, grid))(distances)

    def _support(self) -> tuple[int, int]:
        whole = kernel_shape(self.camera.sensor.shape, self.field_shape)
        scale = (1 + float(self.camera.distance / self.near)) / float(self.camera.sensor.pitch)
        shadow = [math.ceil(float(side) * scale) + 2 * _MARGIN for side in self.camera.mask.extent]
        rows, columns = (min(n + (n - w) % 2, w) for n, w in zip(shadow, whole, strict=True))
        return rows, columns
