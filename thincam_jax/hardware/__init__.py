"""The rig: displays that show patterns, cameras that take frames, stages that move the sensor.

Every device, real or virtual, is a `Camera`, a `Stage` or a `Display`; every failure is a
`HardwareError` with the device, the operation, the cause and a remedy. The rest of the package
imports nothing of this; the libraries of the devices come with `thincam-jax[hardware]`.

The names stand in `__init__.pyi`; each is imported at its first use.
"""

from thincam_jax._core.names import lazy_face

__getattr__, __dir__ = lazy_face(__name__)
