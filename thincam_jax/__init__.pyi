"""The names of `thincam_jax`; `__init__.py` reads them from here."""

from ._core.grids import Grid as Grid
from .commands import plot as plot
from .imaging.scene import ImagePlane as ImagePlane
from .imaging.scene import Scene as Scene
from .imaging.scene import Spectrum as Spectrum
from .imaging.sensor import GaussianNoise as GaussianNoise
from .imaging.sensor import PoissonGaussianNoise as PoissonGaussianNoise
from .imaging.sensor import Sensor as Sensor
from .learn.refocusing.use import Learned as Learned
from .lensless.accuracy import Selection as Selection
from .lensless.accuracy import predict_error as predict_error
from .lensless.accuracy import select_model as select_model
from .lensless.camera import LenslessCamera as LenslessCamera
from .lensless.capture import capture as capture
from .lensless.masks.base import AbstractFactoredMask as AbstractFactoredMask
from .lensless.masks.base import AbstractMask as AbstractMask
from .lensless.masks.base import AxisFactors as AxisFactors
from .lensless.masks.base import MaskTerms as MaskTerms
from .lensless.masks.cells import SeparableMask as SeparableMask
from .lensless.masks.cells import maximum_length_sequence as maximum_length_sequence
from .lensless.masks.display import on_display as on_display
from .lensless.masks.fza import FresnelZoneAperture as FresnelZoneAperture
from .lensless.masks.lenslets import LensletArray as LensletArray
from .lensless.masks.phase import MaskBlank as MaskBlank
from .lensless.masks.phase import PhaseMask as PhaseMask
from .lensless.masks.pinhole import Pinhole as Pinhole
from .lensless.masks.pinhole import RadialMask as RadialMask
from .lensless.masks.redundant_arrays import (
    ModifiedUniformlyRedundantArray as ModifiedUniformlyRedundantArray,
)
from .lensless.masks.redundant_arrays import UniformlyRedundantArray as UniformlyRedundantArray
from .lensless.masks.reliefs import diffuser as diffuser
from .lensless.masks.reliefs import voronoi_fresnel as voronoi_fresnel
from .lensless.masks.sampled import SampledMask as SampledMask
from .lensless.masks.sampled import random_cells as random_cells
from .lensless.masks.sampled import read_mask as read_mask
from .lensless.method import MODELS as MODELS
from .lensless.phase_shift import fringe_scanned_otf as fringe_scanned_otf
from .lensless.phase_shift import harmonic_otf as harmonic_otf
from .lensless.phase_shift import phase_pair_otf as phase_pair_otf
from .lensless.plan import Plan as Plan
from .lensless.plan import plan as plan
from .lensless.psf import otf as otf
from .lensless.psf import psf as psf
from .lensless.sampling import SamplingWarning as SamplingWarning
from .lensless.separable_operator import separable_operator as separable_operator
from .measured.calibration import calibrate_separable as calibrate_separable
from .measured.calibration import fit_psf as fit_psf
from .measured.calibration import fit_separable as fit_separable
from .reconstruction import AdmmTV as AdmmTV
from .reconstruction import Cameras as Cameras
from .reconstruction import Fista as Fista
from .reconstruction import FringeScanning as FringeScanning
from .reconstruction import InverseProblem as InverseProblem
from .reconstruction import PoissonTV as PoissonTV
from .reconstruction import PsfCheck as PsfCheck
from .reconstruction import Psfs as Psfs
from .reconstruction import Recording as Recording
from .reconstruction import Ridge as Ridge
from .reconstruction import Stream as Stream
from .reconstruction import TotalVariation as TotalVariation
from .reconstruction import Wiener as Wiener
from .reconstruction import check_psf as check_psf
from .reconstruction import choose_solver as choose_solver
from .reconstruction import implicit_proximal_gradient as implicit_proximal_gradient
from .reconstruction import reconstruct as reconstruct
from .reconstruction import solve_fixed_point as solve_fixed_point

__version__: str
