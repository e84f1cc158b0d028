"""Coded masks: what the light passes on its way to the sensor."""

from thincam_jax._core.names import modules_of
from thincam_jax.lensless.masks.base import AbstractFactoredMask as AbstractFactoredMask
from thincam_jax.lensless.masks.base import AxisFactors as AxisFactors
from thincam_jax.lensless.masks.base import MaskTerms as MaskTerms
from thincam_jax.lensless.masks.cells import UniformlyRedundantArray as UniformlyRedundantArray
from thincam_jax.lensless.masks.cells import maximum_length_sequence as maximum_length_sequence
from thincam_jax.lensless.masks.phase import MaskBlank as MaskBlank
from thincam_jax.lensless.masks.sampled import random_cells as random_cells

__getattr__ = modules_of(__name__)
