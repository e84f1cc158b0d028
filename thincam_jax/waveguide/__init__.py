"""The see-through-screen camera: holograms on a glass plate, rays and ghosts (thesis chapter 5)."""

from thincam_jax._core.names import modules_of
from thincam_jax.imaging.refractive_index import CauchyIndex as CauchyIndex
from thincam_jax.waveguide.camera import Rectangle as Rectangle
from thincam_jax.waveguide.camera import Screen as Screen
from thincam_jax.waveguide.camera import SeeThroughCamera as SeeThroughCamera
from thincam_jax.waveguide.colours import ColourBand as ColourBand
from thincam_jax.waveguide.colours import ColourCamera as ColourCamera
from thincam_jax.waveguide.distance import distance_from_ghosts as distance_from_ghosts
from thincam_jax.waveguide.hologram import VolumeHologram as VolumeHologram
from thincam_jax.waveguide.planning import plan_screen as plan_screen
from thincam_jax.waveguide.rays import check_screen as check_screen
from thincam_jax.waveguide.rays import trace as trace
from thincam_jax.waveguide.system import LitPlane as LitPlane
from thincam_jax.waveguide.system import ObjectPlane as ObjectPlane
from thincam_jax.waveguide.system import system_operator as system_operator

__getattr__ = modules_of(__name__)
