"""Networks in files, each with every number of its camera: none answers for another camera."""

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from thincam_jax.imaging.scene import Spectrum
from thincam_jax.learn.checkpoint import CheckpointError, difference
from thincam_jax.learn.refocusing.cameras import RefocusCamera
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.reconstruction.imaging_model import Cameras

KIND = "refocusing network"
# By this name the network that comes with the package is known, of configs/learned_refocus.yaml.
SHIPPED = "shipped"
SHIPPED_FILE = Path(__file__).with_name("shipped.thincam")
# Arrays of more numbers are stored as their sum.
_LISTED = 64
# What a sensor makes of light; a network takes captures in any unit.
_ELECTRONIC = ("exposure", "electrons", "full_well", "bit_depth")


def described(value: Any) -> Any:
    """Every number of a module as JSON, by the names of its attributes."""
    if isinstance(value, eqx.Module):
        fields = (field.name for field in dataclasses.fields(value))
        numbers = {name: described(getattr(value, name)) for name in fields}
        return {"type": type(value).__name__, **numbers}
    if isinstance(value, jax.Array | np.ndarray):
        array = np.asarray(value)
        if array.size <= _LISTED and array.dtype.kind in "fiub":
            return array.tolist()
        digest = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
        return f"{array.dtype}{list(array.shape)}, SHA-256 {digest}"
    if isinstance(value, tuple | list):
        return [described(entry) for entry in value]
    if value is None or isinstance(value, str | int | float):
        return value
    return getattr(value, "__name__", type(value).__name__)


def same_camera(
    name: str, there: dict[str, Any], cameras: LenslessCamera | RefocusCamera | Cameras
) -> RefocusCamera:
    """The camera that captures, with the rest of what the network `name` was trained for.

    **Errors**: CheckpointError, one line, for any other than is described in `there`.
    """
    given = _as_trained(name, there, cameras)
    other = difference(_optical(there), _optical(described(given)))
    if other:
        raise CheckpointError(
            f"{name}: was trained for a camera {other}; give the network of this camera, or train "
            "one by 'thincam train'"
        )
    return given


def _as_trained(name: str, there: dict[str, Any], cameras) -> RefocusCamera:
    if isinstance(cameras, RefocusCamera):
        return cameras
    if isinstance(cameras, Cameras) and cameras.count != 1:
        raise CheckpointError(f"{name}: takes one capture, not {cameras.count}; give one camera")
    camera = cameras.cameras[0] if isinstance(cameras, Cameras) else cameras
    try:
        light = Spectrum(*(np.asarray(there["light"][n]) for n in ("wavelengths", "weights")))
        if isinstance(cameras, Cameras) and cameras.wavelength is not None:
            light = Spectrum(cameras.wavelength)
        return RefocusCamera(
            camera,
            light,
            field_shape=tuple(there["field_shape"]),
            **{name: there[name] for name in ("near", "far", "planes", "pupil", "model")},
        )
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{name}: tells no whole camera ({error})") from None


def _optical(camera: Any) -> Any:
    """A description without the sensor's exposure, full well and bits."""
    if not isinstance(camera, dict):
        return camera
    return {name: _optical(value) for name, value in camera.items() if name not in _ELECTRONIC}
