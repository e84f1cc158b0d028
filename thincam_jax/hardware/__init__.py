"""The rig: displays that show patterns, cameras that take frames, stages that move the sensor.

Every device, real or virtual, is a `Camera`, a `Stage` or a `Display`; every failure is a
`HardwareError` with the device, the operation, the cause and a remedy. The rest of the package
imports nothing of this; the libraries of the devices come with `thincam-jax[hardware]`.
"""

from thincam_jax.hardware.acquisition.acquire import acquire as acquire
from thincam_jax.hardware.acquisition.plan import method_b as method_b
from thincam_jax.hardware.acquisition.plan import scene as scene
from thincam_jax.hardware.acquisition.plan import zone_plate as zone_plate
from thincam_jax.hardware.acquisition.read import read_acquisition as read_acquisition
from thincam_jax.hardware.acquisition.rig import open_rig as open_rig
from thincam_jax.hardware.acquisition.taker import Procedure as Procedure
from thincam_jax.hardware.base import Camera as Camera
from thincam_jax.hardware.base import CameraSettings as CameraSettings
from thincam_jax.hardware.base import Device as Device
from thincam_jax.hardware.base import Display as Display
from thincam_jax.hardware.base import Frame as Frame
from thincam_jax.hardware.base import Identity as Identity
from thincam_jax.hardware.base import Region as Region
from thincam_jax.hardware.base import Stage as Stage
from thincam_jax.hardware.displays.phase_levels import PhaseLevels as PhaseLevels
from thincam_jax.hardware.errors import HardwareError as HardwareError
