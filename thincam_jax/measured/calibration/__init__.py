"""Calibration from captures: PSF fits, registration, stripes, Hadamard patterns, screens."""

from thincam_jax._core.names import modules_of
from thincam_jax.measured.calibration.captures import HadamardCaptures as HadamardCaptures
from thincam_jax.measured.calibration.captures import simulate_captures as simulate_captures
from thincam_jax.measured.calibration.hadamard import HadamardSeries as HadamardSeries
from thincam_jax.measured.calibration.registration import (
    estimate_registration as estimate_registration,
)
from thincam_jax.measured.calibration.screen_fit import fit_screen as fit_screen
from thincam_jax.measured.calibration.separable import calibrate_separable as calibrate_separable
from thincam_jax.measured.calibration.system_matrix import recover_matrix as recover_matrix

__getattr__ = modules_of(__name__)
