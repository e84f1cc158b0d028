"""Reconstruct images from captures: recordings, imaging models, and solvers as objects."""

from thincam_jax._core.names import modules_of
from thincam_jax.reconstruction.implicit_gradient import solve_fixed_point as solve_fixed_point
from thincam_jax.reconstruction.problem import InverseProblem as InverseProblem
from thincam_jax.reconstruction.regularisers import Sparsity as Sparsity
from thincam_jax.reconstruction.regularisers import Wavelet as Wavelet
from thincam_jax.reconstruction.solver import AbstractSolver as AbstractSolver
from thincam_jax.reconstruction.synthesis import fringe_scanning as fringe_scanning
from thincam_jax.reconstruction.synthesis import phase_pairs as phase_pairs
from thincam_jax.reconstruction.total_variation import TotalVariation as TotalVariation

__getattr__ = modules_of(__name__)
