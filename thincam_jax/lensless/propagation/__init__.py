"""Propagation models, from the geometric shadow to the Rayleigh-Sommerfeld integral."""

from thincam_jax.lensless.propagation.angular_spectrum import (
    angular_spectrum_sampling as angular_spectrum_sampling,
)
from thincam_jax.lensless.propagation.angular_spectrum import propagate as propagate
from thincam_jax.lensless.propagation.chirp_sum import ChirpSum as ChirpSum
from thincam_jax.lensless.propagation.paraxial import paraxial_response as paraxial_response
from thincam_jax.lensless.propagation.path import Path as Path
