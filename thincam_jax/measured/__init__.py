"""Measured captures: reading files, preparation for a reconstruction, writing images."""

from thincam_jax._core.names import modules_of
from thincam_jax.measured.examination import examine as examine
from thincam_jax.measured.options import Preparation as Preparation
from thincam_jax.measured.preparation import prepare as prepare
from thincam_jax.measured.raw import MeasurementError as MeasurementError
from thincam_jax.measured.raw import Raw as Raw
from thincam_jax.measured.read import read_image as read_image
from thincam_jax.measured.read import read_pixel_map as read_pixel_map
from thincam_jax.measured.sensor import measure_sensor as measure_sensor
from thincam_jax.measured.write import to_display as to_display
from thincam_jax.measured.write import write_image as write_image

__getattr__ = modules_of(__name__)
