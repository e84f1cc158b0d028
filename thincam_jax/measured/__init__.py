"""Measured captures: reading files, preparation for a reconstruction, writing images."""

from thincam_jax.measured.bayer import demosaic as demosaic
from thincam_jax.measured.containers import unpack_raw as unpack_raw
from thincam_jax.measured.examination import examine as examine
from thincam_jax.measured.exposures import ExposedFrames as ExposedFrames
from thincam_jax.measured.exposures import merge_exposures as merge_exposures
from thincam_jax.measured.options import Preparation as Preparation
from thincam_jax.measured.preparation import prepare as prepare
from thincam_jax.measured.raw import CaptureFileError as CaptureFileError
from thincam_jax.measured.raw import MeasurementError as MeasurementError
from thincam_jax.measured.raw import Raw as Raw
from thincam_jax.measured.read import NonlinearWarning as NonlinearWarning
from thincam_jax.measured.read import list_captures as list_captures
from thincam_jax.measured.read import read_image as read_image
from thincam_jax.measured.read import read_images as read_images
from thincam_jax.measured.read import read_mask as read_mask
from thincam_jax.measured.sensor import SensorCalibration as SensorCalibration
from thincam_jax.measured.sensor import measure_sensor as measure_sensor
from thincam_jax.measured.write import to_display as to_display
from thincam_jax.measured.write import write_image as write_image
