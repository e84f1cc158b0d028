"""Coded masks: what the light passes on its way to the sensor."""

from thincam_jax.lensless.masks.base import AbstractFactoredMask as AbstractFactoredMask
from thincam_jax.lensless.masks.base import AbstractMask as AbstractMask
from thincam_jax.lensless.masks.cells import SeparableMask as SeparableMask
from thincam_jax.lensless.masks.cells import maximum_length_sequence as maximum_length_sequence
from thincam_jax.lensless.masks.display import on_display as on_display
from thincam_jax.lensless.masks.fza import FresnelZoneAperture as FresnelZoneAperture
from thincam_jax.lensless.masks.lenslets import LensletArray as LensletArray
from thincam_jax.lensless.masks.phase import PhaseMask as PhaseMask
from thincam_jax.lensless.masks.pinhole import Pinhole as Pinhole
from thincam_jax.lensless.masks.pinhole import RadialMask as RadialMask
from thincam_jax.lensless.masks.redundant_arrays import (
    ModifiedUniformlyRedundantArray as ModifiedUniformlyRedundantArray,
)
from thincam_jax.lensless.masks.redundant_arrays import (
    UniformlyRedundantArray as UniformlyRedundantArray,
)
from thincam_jax.lensless.masks.reliefs import diffuser as diffuser
from thincam_jax.lensless.masks.reliefs import voronoi_fresnel as voronoi_fresnel
from thincam_jax.lensless.masks.sampled import SampledMask as SampledMask
from thincam_jax.lensless.masks.sampled import random_cells as random_cells
from thincam_jax.lensless.masks.sampled import read_mask as read_mask
