"""Coded masks: what the light passes on its way to the sensor."""

from thincam_jax.lensless.masks.base import AbstractMask as AbstractMask
from thincam_jax.lensless.masks.base import ZoneOrders as ZoneOrders
from thincam_jax.lensless.masks.fza import FresnelZoneAperture as FresnelZoneAperture
from thincam_jax.lensless.masks.phase import MaskBlank as MaskBlank
from thincam_jax.lensless.masks.phase import PhaseMask as PhaseMask
from thincam_jax.lensless.masks.reliefs import diffuser as diffuser
from thincam_jax.lensless.masks.reliefs import voronoi_fresnel as voronoi_fresnel
from thincam_jax.lensless.masks.sampled import SampledMask as SampledMask
