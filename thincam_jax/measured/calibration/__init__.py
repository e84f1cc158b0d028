"""What a rig's own pictures say of it: PSF fits and the registration of reconstructions."""

from thincam_jax.measured.calibration.problem import PARAMETERS as PARAMETERS
from thincam_jax.measured.calibration.psf_fit import PsfFit as PsfFit
from thincam_jax.measured.calibration.psf_fit import fit_psf as fit_psf
from thincam_jax.measured.calibration.registration import Registration as Registration
from thincam_jax.measured.calibration.registration import (
    estimate_registration as estimate_registration,
)
