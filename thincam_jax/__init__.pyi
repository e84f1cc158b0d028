"""The names of `thincam_jax`; `__init__.py` reads them from here."""

from . import design as design
from . import hardware as hardware
from . import imaging as imaging
from . import learn as learn
from . import lensless as lensless
from . import measured as measured
from . import plot as plot
from . import reconstruction as reconstruction
from . import studies as studies
from . import units as units
from . import waveguide as waveguide
from ._core.grids import Grid as Grid
from .imaging.scene import ImagePlane as ImagePlane
from .imaging.scene import Scene as Scene
from .imaging.scene import Spectrum as Spectrum
from .imaging.sensor import GaussianNoise as GaussianNoise
from .imaging.sensor import PoissonGaussianNoise as PoissonGaussianNoise
from .imaging.sensor import Sensor as Sensor
from .imaging.targets.images import load_image as load_image
from .learn.plug_and_play import PlugAndPlay as PlugAndPlay
from .learn.refocusing.use import Learned as Learned
from .lensless.accuracy.select import choose_model as choose_model
from .lensless.accuracy.select import predict_error as predict_error
from .lensless.camera import LenslessCamera as LenslessCamera
from .lensless.capture import capture as capture
from .lensless.exposures import Exposures as Exposures
from .lensless.field import field_operator as field_operator
from .lensless.masks.fza import FresnelZoneAperture as FresnelZoneAperture
from .lensless.masks.phase import PhaseMask as PhaseMask
from .lensless.masks.pinhole import LensletArray as LensletArray
from .lensless.masks.pinhole import Pinhole as Pinhole
from .lensless.masks.pinhole import RadialMask as RadialMask
from .lensless.masks.redundant_arrays import (
    ModifiedUniformlyRedundantArray as ModifiedUniformlyRedundantArray,
)
from .lensless.masks.redundant_arrays import SeparableMask as SeparableMask
from .lensless.masks.sampled import SampledMask as SampledMask
from .lensless.masks.sampled import read_mask as read_mask
from .lensless.method import PsfMethod as PsfMethod
from .lensless.mosaic import Mosaic as Mosaic
from .lensless.plan.make import plan_capture as plan_capture
from .lensless.psf import mtf as mtf
from .lensless.psf import otf as otf
from .lensless.psf import psf as psf
from .lensless.separable_operator import separable_operator as separable_operator
from .measured.calibration.psf_fit import fit_psf as fit_psf
from .plot.page import explore as explore
from .reconstruction.fringe_filter import FringeScanning as FringeScanning
from .reconstruction.imaging_model import Cameras as Cameras
from .reconstruction.imaging_model import Psfs as Psfs
from .reconstruction.methods import AdmmTV as AdmmTV
from .reconstruction.methods import Fista as Fista
from .reconstruction.methods import choose_solver as choose_solver
from .reconstruction.methods import reconstruct as reconstruct
from .reconstruction.poisson import PoissonTV as PoissonTV
from .reconstruction.psf_check import check_psf as check_psf
from .reconstruction.record import record as record
from .reconstruction.recording import Recording as Recording
from .reconstruction.refinement import refine as refine
from .reconstruction.ridge import Ridge as Ridge
from .reconstruction.stream import Stream as Stream
from .reconstruction.wiener import Wiener as Wiener

__version__: str
