"""Virtual devices: the optics of this package behind the real protocols, with faults."""

from thincam_jax.hardware.virtual.optics import ModulatorOptics as ModulatorOptics
from thincam_jax.hardware.virtual.rig import Electronics as Electronics
from thincam_jax.hardware.virtual.rig import VirtualRig as VirtualRig
