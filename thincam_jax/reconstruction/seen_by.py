"""What took the captures: cameras whose PSFs are computed, or PSFs that were measured."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.checks import Numbers
from thincam_jax._core.module import Module
from thincam_jax._core.quantity import choice, unchecked
from thincam_jax.imaging.operators import kernel_grid
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.method import MODELS, Model
from thincam_jax.lensless.psf import psf
from thincam_jax.reconstruction.registration import own_field, register

_DARK = 0.3  # of a PSF's absolute sum


def _cameras(given: Sequence[LenslessCamera]) -> tuple[LenslessCamera, ...]:
    if isinstance(given, LenslessCamera):
        raise TypeError("cameras is one camera; give a list, [camera], one for each capture")
    cameras = tuple(given)
    if not cameras:
        raise ValueError("cameras is empty; give one camera for each capture")
    if not all(isinstance(camera, LenslessCamera) for camera in cameras):
        raise TypeError("cameras holds something else; give LenslessCameras, or use Psfs")
    return cameras


class Cameras(Module):
    """Cameras whose PSFs are computed, one for each capture, with the light that they saw.

    **Arguments**

    - `cameras`: what took the captures. Captures at several mask-sensor distances are brought to
      the scale of the largest (`register`), and their PSFs with them.
    - `wavelength`: mm, one or one for each camera.
    - `object_distance`: t, mm, on which to focus. Several make as many planes, each seen in its own
      projection, so that pixels of the planes that are behind each other lie on one ray through
      the mask.
    - `field_shape`: pixels of the image, default those of the sensor; light from beyond is taken
      for none. Its pixels are p·t/d apart on the object, d the largest distance.
    - `model`, `pixel_integration`: of the PSFs, see `thincam_jax.psf`.
    """

    cameras: tuple[LenslessCamera, ...] = eqx.field(converter=_cameras)
    wavelength: Any = eqx.field(default=None, converter=unchecked("mm"), kw_only=True)
    object_distance: Any = eqx.field(default=None, converter=unchecked("mm"), kw_only=True)
    field_shape: tuple[int, int] | None = eqx.field(default=None, static=True, kw_only=True)
    model: Model = eqx.field(
        default="separable", converter=choice(MODELS), static=True, kw_only=True
    )
    pixel_integration: bool = eqx.field(default=True, converter=bool, static=True, kw_only=True)

    @property
    def count(self) -> int:
        """Captures that belong to these."""
        return len(self.cameras)

    @property
    def pitch(self) -> Float[Array, "*plane"]:
        """Distance of the image's pixels on the object, mm: p·t/d of the largest d."""
        furthest = max(self.cameras, key=lambda c: float(c.distance))
        return furthest.sensor.pitch * jnp.asarray(self.object_distance) / furthest.distance

    def require(self, *names: str) -> None:
        """One line for what is needed and was not told."""
        missing = [name for name in names if getattr(self, name) is None]
        if missing:
            raise ValueError(f"the Cameras have no {' and no '.join(missing)}; give it in mm")

    def kernels(
        self, field: tuple[int, int], ratios: Sequence[float]
    ) -> list[Float[Array, "1 plane k l"]]:
        """PSF of each camera and plane on the reference scale; enlarged by r, 1/r² as bright."""
        self.require("wavelength", "object_distance")
        distances = np.atleast_1d(np.asarray(self.object_distance, dtype=object))
        wavelengths = jnp.broadcast_to(jnp.asarray(self.wavelength), (self.count,))
        kernels = []
        for camera, wavelength, ratio in zip(self.cameras, wavelengths, ratios, strict=True):
            grid = kernel_grid(camera.sensor.grid, own_field(field, ratio))
            planes = [
                psf(
                    camera,
                    wavelength=wavelength,
                    object_distance=distance,
                    grid=grid,
                    model=self.model,
                    pixel_integration=self.pixel_integration,
                )
                for distance in distances
            ]
            kernels.append(jnp.stack([register(k, ratio) / ratio**2 for k in planes])[None])
        return kernels


class Psfs(Module):
    """Measured PSFs on the pixels of the captures, one for each capture.

    **Arguments**

    - `psfs`: (capture, k, l), (capture, channel, k, l) or (capture, channel, plane, k, l), the
      channel axis of length 1 or that of the captures.
    - `field_shape`: pixels of the field; default all that sends light to the sensor, sensor +
      PSF − 1. The image is then the part in front of the sensor, else the field that is given.
    """

    psfs: Float[Array, "capture channel plane k l"]
    field_shape: tuple[int, int] | None = eqx.field(static=True)

    def __init__(self, psfs: Numbers, *, field_shape: tuple[int, int] | None = None):
        psfs = jnp.asarray(psfs)
        checks.channels_first("psfs", psfs.shape)
        _require_light(psfs)
        if not 3 <= psfs.ndim <= 5:
            raise ValueError(
                f"PSFs have shape {psfs.shape}; give (capture, k, l), such as psf[None] for one, "
                "(capture, channel, k, l) or (capture, channel, plane, k, l)"
            )
        self.psfs = psfs.reshape(*psfs.shape[:-2], *(1,) * (5 - psfs.ndim), *psfs.shape[-2:])
        self.field_shape = field_shape

    @property
    def count(self) -> int:
        """Captures that belong to these."""
        return self.psfs.shape[0]


def _require_light(psfs: Array) -> None:
    """PSFs are numbers, and more of one is light than its negative."""
    if checks.is_traced(psfs):
        return
    values = np.asarray(psfs)
    if not np.isfinite(values).all():
        raise ValueError("the PSFs hold NaN or infinity; give finite irradiances")
    if not values.any():
        raise ValueError("the PSFs are zero everywhere; give PSFs that send light")
    light = values.sum(axis=(-2, -1), dtype=float)
    # Differences of PSFs have sums of about zero, of either sign.
    if (light < -_DARK * np.abs(values).sum(axis=(-2, -1), dtype=float)).any():
        raise ValueError(
            f"a PSF sums to {light.min():.3g}, which is negative: too large a background was "
            "subtracted, or its sign is wrong; give PSFs of positive irradiance"
        )
