"""The names of `thincam_jax.hardware`; `__init__.py` reads them from here."""

from thincam_jax.hardware.base import HardwareError as HardwareError

from . import plans as plans
from .acquisition.acquire import acquire as acquire
from .acquisition.read import Acquisition as Acquisition
from .acquisition.rig import open_rig as open_rig
from .base import Camera as Camera
from .base import CameraSettings as CameraSettings
from .base import Display as Display
from .base import Stage as Stage
