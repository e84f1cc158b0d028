"""thincam_jax: simulate, reconstruct and design thin computational cameras, in JAX."""

from thincam_jax.camera import LenslessCamera as LenslessCamera
from thincam_jax.capture import capture as capture
from thincam_jax.grids import Grid as Grid
from thincam_jax.masks.fza import FresnelZoneAperture as FresnelZoneAperture
from thincam_jax.masks.sampled import SampledMask as SampledMask
from thincam_jax.planning import Plan as Plan
from thincam_jax.planning import plan as plan
from thincam_jax.psf import MODELS as MODELS
from thincam_jax.psf import otf as otf
from thincam_jax.psf import psf as psf
from thincam_jax.reconstruct import FringeScanning as FringeScanning
from thincam_jax.reconstruct import WienerSynthesis as WienerSynthesis
from thincam_jax.reconstruct import reconstruct as reconstruct
from thincam_jax.responses import fringe_scanned_otf as fringe_scanned_otf
from thincam_jax.responses import phase_pair_otf as phase_pair_otf
from thincam_jax.scene import ImagePlane as ImagePlane
from thincam_jax.scene import Scene as Scene
from thincam_jax.scene import Spectrum as Spectrum
from thincam_jax.selection import Selection as Selection
from thincam_jax.selection import predict_error as predict_error
from thincam_jax.selection import select_model as select_model
from thincam_jax.sensor import GaussianNoise as GaussianNoise
from thincam_jax.sensor import PoissonGaussianNoise as PoissonGaussianNoise
from thincam_jax.sensor import Sensor as Sensor
