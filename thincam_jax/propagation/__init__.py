"""Propagation models, from the geometric shadow to the Rayleigh-Sommerfeld integral."""

from thincam_jax.propagation.angular_spectrum import Sampling as Sampling
from thincam_jax.propagation.angular_spectrum import angular_spectrum as angular_spectrum
from thincam_jax.propagation.angular_spectrum import (
    angular_spectrum_sampling as angular_spectrum_sampling,
)
from thincam_jax.propagation.angular_spectrum import propagate as propagate
from thincam_jax.propagation.chirps import ChirpSum as ChirpSum
from thincam_jax.propagation.closed_form import closed_form as closed_form
from thincam_jax.propagation.geometric import geometric as geometric
from thincam_jax.propagation.paraxial import paraxial as paraxial
from thincam_jax.propagation.paraxial import paraxial_response as paraxial_response
from thincam_jax.propagation.path import Path as Path
from thincam_jax.propagation.rayleigh_sommerfeld import rayleigh_sommerfeld as rayleigh_sommerfeld
from thincam_jax.propagation.separable import separable as separable
from thincam_jax.propagation.separable_sum import SeparableSum as SeparableSum
