"""The rig: displays that show patterns, cameras that take frames, stages that move the sensor.

Every device, real or virtual, is a `Camera`, a `Stage` or a `Display`; every failure is a
`HardwareError` with the device, the operation, the cause and a remedy. The rest of the package
imports nothing of this; the libraries of the devices come with `thincam-jax[hardware]`.
"""

from thincam_jax._core.names import modules_of
from thincam_jax.hardware import plans as plans
from thincam_jax.hardware.acquisition.acquire import acquire as acquire
from thincam_jax.hardware.acquisition.read import Acquisition as Acquisition
from thincam_jax.hardware.acquisition.rig import open_rig as open_rig
from thincam_jax.hardware.base import Camera as Camera
from thincam_jax.hardware.base import CameraSettings as CameraSettings
from thincam_jax.hardware.base import Display as Display
from thincam_jax.hardware.base import Stage as Stage
from thincam_jax.hardware.errors import HardwareError as HardwareError

__getattr__ = modules_of(__name__)
