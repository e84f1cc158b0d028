"""Virtual devices: the optics of this package behind the real protocols, with faults."""

from thincam_jax._core.names import modules_of
from thincam_jax.hardware.virtual.rig import VirtualRig as VirtualRig

__getattr__ = modules_of(__name__)
