"""From captures back to an image: one entry point, one file a method."""

from thincam_jax.reconstruction.build import camera_problem as camera_problem
from thincam_jax.reconstruction.build import psf_problem as psf_problem
from thincam_jax.reconstruction.drive import Progress as Progress
from thincam_jax.reconstruction.entry import METHODS as METHODS
from thincam_jax.reconstruction.entry import reconstruct as reconstruct
from thincam_jax.reconstruction.fixed_point import FixedPoint as FixedPoint
from thincam_jax.reconstruction.fixed_point import solve_fixed_point as solve_fixed_point
from thincam_jax.reconstruction.fringe_filter import FringeScanning as FringeScanning
from thincam_jax.reconstruction.plug_and_play import solve_plug_and_play as solve_plug_and_play
from thincam_jax.reconstruction.poisson import solve_poisson as solve_poisson
from thincam_jax.reconstruction.poisson_newton import solve_poisson_newton as solve_poisson_newton
from thincam_jax.reconstruction.problem import Deconvolution as Deconvolution
from thincam_jax.reconstruction.proximal import solve_proximal as solve_proximal
from thincam_jax.reconstruction.registration import register as register
from thincam_jax.reconstruction.result import Reconstruction as Reconstruction
from thincam_jax.reconstruction.ridge import solve_ridge as solve_ridge
from thincam_jax.reconstruction.synthesis import contrasts as contrasts
from thincam_jax.reconstruction.synthesis import fringe_scanning as fringe_scanning
from thincam_jax.reconstruction.synthesis import phase_pairs as phase_pairs
from thincam_jax.reconstruction.synthesis import separate as separate
from thincam_jax.reconstruction.total_variation import TotalVariation as TotalVariation
from thincam_jax.reconstruction.two_step import solve_two_step as solve_two_step
from thincam_jax.reconstruction.wiener import WienerSynthesis as WienerSynthesis
