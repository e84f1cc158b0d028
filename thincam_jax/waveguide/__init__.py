"""The see-through-screen camera: holograms on a glass plate, rays and ghosts (thesis chapter 5)."""

from thincam_jax.imaging.refractive_index import CauchyIndex as CauchyIndex
from thincam_jax.imaging.refractive_index import ConstantIndex as ConstantIndex
from thincam_jax.imaging.refractive_index import SellmeierIndex as SellmeierIndex
from thincam_jax.imaging.refractive_index import bk7 as bk7
from thincam_jax.waveguide.camera import Rectangle as Rectangle
from thincam_jax.waveguide.camera import Screen as Screen
from thincam_jax.waveguide.camera import SeeThroughCamera as SeeThroughCamera
from thincam_jax.waveguide.efficiency import diffraction_efficiency as diffraction_efficiency
from thincam_jax.waveguide.efficiency import ghost_weights as ghost_weights
from thincam_jax.waveguide.hologram import VolumeHologram as VolumeHologram
from thincam_jax.waveguide.hologram import refracted as refracted
from thincam_jax.waveguide.planning import LitPlane as LitPlane
from thincam_jax.waveguide.planning import Plan as Plan
from thincam_jax.waveguide.planning import plan as plan
from thincam_jax.waveguide.rays import Rays as Rays
from thincam_jax.waveguide.rays import RayStatus as RayStatus
from thincam_jax.waveguide.rays import check_screen as check_screen
from thincam_jax.waveguide.rays import pixel_centres as pixel_centres
from thincam_jax.waveguide.rays import trace as trace
from thincam_jax.waveguide.screen_to_sensor import GhostImages as GhostImages
from thincam_jax.waveguide.screen_to_sensor import ghost_images as ghost_images
from thincam_jax.waveguide.screen_to_sensor import ghost_psfs as ghost_psfs
from thincam_jax.waveguide.smear import SmearedRays as SmearedRays
from thincam_jax.waveguide.smear import trace_band as trace_band
from thincam_jax.waveguide.system import ObjectPlane as ObjectPlane
from thincam_jax.waveguide.system import system_operator as system_operator
