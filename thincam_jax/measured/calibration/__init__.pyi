"""The names of `thincam_jax.measured.calibration`; `__init__.py` reads them from here."""

from ...waveguide.measured.screen_fit import fit_screen as fit_screen
from .captures import HadamardCaptures as HadamardCaptures
from .captures import simulate_captures as simulate_captures
from .hadamard import HadamardSeries as HadamardSeries
from .registration import estimate_registration as estimate_registration
from .separable import calibrate_separable as calibrate_separable
from .separable import fit_separable as fit_separable
from .system_matrix import recover_matrix as recover_matrix
