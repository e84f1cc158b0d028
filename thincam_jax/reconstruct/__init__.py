"""From captures back to an image: one entry point, one file a method."""

from thincam_jax.reconstruct.build import camera_problem as camera_problem
from thincam_jax.reconstruct.build import psf_problem as psf_problem
from thincam_jax.reconstruct.drive import Progress as Progress
from thincam_jax.reconstruct.entry import METHODS as METHODS
from thincam_jax.reconstruct.entry import reconstruct as reconstruct
from thincam_jax.reconstruct.fixed_point import FixedPoint as FixedPoint
from thincam_jax.reconstruct.fixed_point import solve_fixed_point as solve_fixed_point
from thincam_jax.reconstruct.fringe_scanning import FringeScanning as FringeScanning
from thincam_jax.reconstruct.plug_and_play import solve_plug_and_play as solve_plug_and_play
from thincam_jax.reconstruct.poisson import solve_poisson as solve_poisson
from thincam_jax.reconstruct.poisson_newton import solve_poisson_newton as solve_poisson_newton
from thincam_jax.reconstruct.problem import Deconvolution as Deconvolution
from thincam_jax.reconstruct.proximal import solve_proximal as solve_proximal
from thincam_jax.reconstruct.registration import register as register
from thincam_jax.reconstruct.result import Reconstruction as Reconstruction
from thincam_jax.reconstruct.ridge import solve_ridge as solve_ridge
from thincam_jax.reconstruct.synthesis import contrasts as contrasts
from thincam_jax.reconstruct.synthesis import fringe_scanning as fringe_scanning
from thincam_jax.reconstruct.synthesis import phase_pairs as phase_pairs
from thincam_jax.reconstruct.synthesis import separate as separate
from thincam_jax.reconstruct.total_variation import TotalVariation as TotalVariation
from thincam_jax.reconstruct.two_step import solve_two_step as solve_two_step
from thincam_jax.reconstruct.unrolled import UnrolledAdmm as UnrolledAdmm
from thincam_jax.reconstruct.wiener import WienerSynthesis as WienerSynthesis
