"""The names of `thincam_jax.waveguide`; `__init__.py` reads them from here."""

from ..imaging.refractive_index import CauchyIndex as CauchyIndex
from .camera import ObjectPlane as ObjectPlane
from .camera import Rectangle as Rectangle
from .camera import Screen as Screen
from .camera import SeeThroughCamera as SeeThroughCamera
from .colours import ColourBand as ColourBand
from .colours import ColourCamera as ColourCamera
from .distance import distance_from_ghosts as distance_from_ghosts
from .hologram import VolumeHologram as VolumeHologram
from .planning import plan_screen as plan_screen
from .rays import check_screen as check_screen
from .rays import trace as trace
from .system import LitPlane as LitPlane
from .system import system_operator as system_operator
