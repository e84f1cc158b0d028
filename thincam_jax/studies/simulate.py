"""Captures of a study: the noise-free image, the exposure, and what is read out."""

import functools
import operator
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from thincam_jax.imaging.scene import ImagePlane, Scene
from thincam_jax.imaging.sensor import electrons_per_unit, read_out
from thincam_jax.lensless import forward
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.lensless.method import PsfMethod
from thincam_jax.studies.study import Study, Target


@dataclass(frozen=True, eq=False)
class Capture:
    """Image read out (*channel, y, x), and the variance of its noise (*channel,)."""

    image: np.ndarray
    variance: np.ndarray


def noise_free(study: Study, exposure: Exposure, planes: ImagePlane | list[ImagePlane]) -> Array:
    """Light on the sensor, (*channel, y, x), without saturation."""
    scene, pixels = Scene(planes, exposure.wavelength), study.pixel_integration
    method = PsfMethod(study.model, None, pixels, field_tolerance=study.field_tolerance)
    images = (
        forward.expose(study.camera(exposure), plane, scene.spectrum, method)
        for plane in scene.planes
    )
    return functools.reduce(operator.add, images)


def expose(study: Study, exposure: Exposure, clean: Array, number: int, trial: int = 0) -> Capture:
    """Capture from a noise-free image of the target of a number.

    The noise is that of the image; its random key is the same however a study is interrupted, and
    another one for each further trial.
    """
    seed = jax.random.key((study.seed + trial) % 2**32)
    place = study.exposures.index(exposure)
    key = jax.random.fold_in(jax.random.fold_in(seed, number), place)
    sensor, noise = study.camera(exposure).sensor, study.noise
    if noise is None:
        variance = np.zeros(clean.shape[:-2], clean.dtype)
    else:
        variance = np.asarray(noise.variance(clean, electrons_per_unit(sensor, clean)))
    return Capture(np.asarray(read_out(sensor, clean, noise=noise, key=key)), variance)


def take(study: Study, exposure: Exposure, target: Target) -> Capture:
    """One capture of a target, which may move meanwhile."""
    plane = ImagePlane(target.plane.image, target.distance, target.width, exposure.moves)
    return expose(study, exposure, noise_free(study, exposure, plane), target.number)


def stacked(captures: Sequence[Capture]) -> tuple[Array, Array]:
    """Images (capture, *channel, y, x) and variances (capture, *channel)."""
    images, variances = [c.image for c in captures], [c.variance for c in captures]
    return jnp.asarray(np.stack(images)), jnp.asarray(np.stack(variances))
