"""Reconstruct images from captures: recordings, imaging models, and solvers as objects."""

from thincam_jax.reconstruction.fringe_filter import FringeScanning as FringeScanning
from thincam_jax.reconstruction.imaging_model import Cameras as Cameras
from thincam_jax.reconstruction.imaging_model import Psfs as Psfs
from thincam_jax.reconstruction.implicit_gradient import (
    implicit_proximal_gradient as implicit_proximal_gradient,
)
from thincam_jax.reconstruction.implicit_gradient import solve_fixed_point as solve_fixed_point
from thincam_jax.reconstruction.methods import AdmmTV as AdmmTV
from thincam_jax.reconstruction.methods import Fista as Fista
from thincam_jax.reconstruction.methods import choose_solver as choose_solver
from thincam_jax.reconstruction.methods import reconstruct as reconstruct
from thincam_jax.reconstruction.noise import estimate_noise as estimate_noise
from thincam_jax.reconstruction.poisson import PoissonTV as PoissonTV
from thincam_jax.reconstruction.poisson import solve_poisson as solve_poisson
from thincam_jax.reconstruction.problem import InverseProblem as InverseProblem
from thincam_jax.reconstruction.proximal_gradient import solve_fista as solve_fista
from thincam_jax.reconstruction.psf_check import check_psf as check_psf
from thincam_jax.reconstruction.recording import Recording as Recording
from thincam_jax.reconstruction.refinement import refine as refine
from thincam_jax.reconstruction.regularisers import Sparsity as Sparsity
from thincam_jax.reconstruction.regularisers import Wavelet as Wavelet
from thincam_jax.reconstruction.result import Reconstruction as Reconstruction
from thincam_jax.reconstruction.ridge import Ridge as Ridge
from thincam_jax.reconstruction.ridge import solve_ridge as solve_ridge
from thincam_jax.reconstruction.solver import AbstractSolver as AbstractSolver
from thincam_jax.reconstruction.stream import Stream as Stream
from thincam_jax.reconstruction.synthesis import contrasts as contrasts
from thincam_jax.reconstruction.synthesis import fringe_scanning as fringe_scanning
from thincam_jax.reconstruction.synthesis import harmonics as harmonics
from thincam_jax.reconstruction.synthesis import phase_pairs as phase_pairs
from thincam_jax.reconstruction.synthesis import separate as separate
from thincam_jax.reconstruction.total_variation import TotalVariation as TotalVariation
from thincam_jax.reconstruction.wiener import Wiener as Wiener
from thincam_jax.reconstruction.wiener import WienerSynthesis as WienerSynthesis
