"""Baselines of refocusing networks: a linear filter, and a network given a distance code.

`thincam_jax.AdmmTV` and `thincam_jax.learn.UnrolledAdmm` are the others.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax.learn.refocusing.cameras import RefocusCamera
from thincam_jax.learn.refocusing.network import constant_images, noise_level
from thincam_jax.learn.refocusing.planes import LinearStep, Planes
from thincam_jax.learn.refocusing.scenes import Batch
from thincam_jax.learn.refocusing.train import Parts, relative_error
from thincam_jax.learn.refocusing.unet import UNet


def wiener(
    planes: Planes,
    capture: Float[Array, "y x"],
    deviation: Float[Array, ""],
    distance: Float[Array, ""],
    strength: float | Float[Array, ""] = 1.0,
) -> Float[Array, "m n"]:
    """The Wiener filter of the exact PSF at a distance, mm, for scenes of the spectrum 1/ρ².

    All of the scene is taken to stand there. `strength`: factor on the noise's power, best tuned on
    scenes of the kind, as light from other distances is not noise of the sensor's kind.
    """
    step = LinearStep(1)
    noise = jnp.log(jnp.asarray([strength, 1e-6]))
    step = eqx.tree_at(lambda s: s.noise, step, noise)
    return _inverted(planes, step, capture, deviation, distance)[0]


class ControlCode(eqx.Module):
    """The thesis' own idea (chapter 4) in small: a network that is told the distance as a code.

    The code is a constant image, 0 for the farthest distance to 1 for the nearest, beside the image
    that the network reads. A U-Net sees too little of a capture, whose points are wider than its
    reach, so that it reads the linear inversion at the middle distance, which is always the same.
    """

    step: LinearStep
    unet: UNet
    planes: Planes

    @staticmethod
    def create(
        camera: RefocusCamera, widths: tuple[int, ...] = (64, 96, 128), *, key: PRNGKeyArray
    ) -> "ControlCode":
        return ControlCode(LinearStep(1), UNet(3, 1, widths, key=key), Planes(camera))

    def focus(
        self, capture: Float[Array, "y x"], distance: Float[Array, ""], deviation: Float[Array, ""]
    ) -> Float[Array, "m n"]:
        """The image focused on a distance, mm, in the capture's unit."""
        camera, planes = self.planes.camera, self.planes
        image = _inverted(planes, self.step, capture, deviation, camera.middle)
        mean = planes.mean(capture)
        unit = jnp.where(mean > 0, mean, 1)
        code = (1 + camera.stand(distance).position) / 2
        level = noise_level(deviation / (unit * planes.unit))
        told = constant_images(image, code, level)
        return image[0] + unit * self.unet(jnp.concatenate([image / unit, told]))[0]


def control_loss(network: ControlCode, batch: Batch) -> tuple[Float[Array, ""], Parts]:
    """½ ln of the relative mean squared error of the focused image, as in `loss`."""
    images = jax.vmap(network.focus)(batch.capture, batch.commanded, batch.deviation)
    focus = jnp.mean(jax.vmap(relative_error)(images, batch.image))
    return focus, {"focus": focus}


def _inverted(planes: Planes, step: LinearStep, capture, deviation, distance):
    """An image (1, y, x) in the capture's unit: a uniform scene and what the filter adds to it."""
    mean = planes.mean(capture)
    unit = planes.unit * jnp.where(mean > 0, mean, 1)
    residual = (capture - mean * planes.uniform) / unit
    spectrum = jnp.fft.rfft2(planes.from_sensor(residual))
    spectra = planes.spectra_at(distance[None])
    added = step(spectrum, spectra, (deviation / unit) ** 2, planes)
    return mean * (1 + planes.on_field(added))
