"""The lensless camera: a coded mask at a distance in front of a sensor."""

from thincam_jax._core.names import modules_of
from thincam_jax._core.precision import AccuracyWarning as AccuracyWarning
from thincam_jax.lensless.camera import LightPath as LightPath
from thincam_jax.lensless.field import shading as shading

__getattr__ = modules_of(__name__)
