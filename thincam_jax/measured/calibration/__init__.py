"""Calibration from captures: PSF fits, registration, stripes, Hadamard patterns, screens."""

from thincam_jax.measured.calibration.captures import create_captures as create_captures
from thincam_jax.measured.calibration.captures import open_captures as open_captures
from thincam_jax.measured.calibration.captures import resume_captures as resume_captures
from thincam_jax.measured.calibration.captures import simulate_captures as simulate_captures
from thincam_jax.measured.calibration.hadamard import HadamardSeries as HadamardSeries
from thincam_jax.measured.calibration.hadamard import hadamard_pattern as hadamard_pattern
from thincam_jax.measured.calibration.hadamard import walsh_hadamard as walsh_hadamard
from thincam_jax.measured.calibration.psf_fit import fit_psf as fit_psf
from thincam_jax.measured.calibration.registration import (
    estimate_registration as estimate_registration,
)
from thincam_jax.measured.calibration.screen_fit import GhostPositions as GhostPositions
from thincam_jax.measured.calibration.screen_fit import fit_screen as fit_screen
from thincam_jax.measured.calibration.separable import calibrate_separable as calibrate_separable
from thincam_jax.measured.calibration.separable import fit_separable as fit_separable
from thincam_jax.measured.calibration.system_matrix import matrix_blocks as matrix_blocks
from thincam_jax.measured.calibration.system_matrix import open_matrix as open_matrix
from thincam_jax.measured.calibration.system_matrix import read_matrix as read_matrix
from thincam_jax.measured.calibration.system_matrix import recover_matrix as recover_matrix
from thincam_jax.measured.calibration.system_matrix import stored_blocks as stored_blocks
from thincam_jax.measured.calibration.system_matrix import write_matrix as write_matrix
