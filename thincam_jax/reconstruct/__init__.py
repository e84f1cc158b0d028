"""From captures back to an image: one entry point, one file a method."""

from thincam_jax.reconstruct.entry import METHODS as METHODS
from thincam_jax.reconstruct.entry import reconstruct as reconstruct
from thincam_jax.reconstruct.fringe_scanning import FringeScanning as FringeScanning
from thincam_jax.reconstruct.registration import register as register
from thincam_jax.reconstruct.result import Reconstruction as Reconstruction
from thincam_jax.reconstruct.synthesis import fringe_scanning as fringe_scanning
from thincam_jax.reconstruct.synthesis import phase_pairs as phase_pairs
from thincam_jax.reconstruct.synthesis import separate as separate
from thincam_jax.reconstruct.wiener import WienerSynthesis as WienerSynthesis
