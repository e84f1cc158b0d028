"""The thesis' camera, as the tests of this folder judge it."""

import jax.numpy as jnp
import numpy as np

from thincam_jax.design import DesignSpace, Setup, SignalNoise, Variable, shots
from thincam_jax.design.design import Design
from thincam_jax.design.objectives import bayes_error, channels
from thincam_jax.reconstruction import phase_pairs

WAVELENGTH = 500e-6
PAIR = (0.0, 1.5 * np.pi)
WIDTH = 5.632
HIGHEST = 290.0  # cycles/rad: 45 cycles/mm at 6.5 mm, half of the sensor's Nyquist frequency


def setup(**changed) -> Setup:
    thesis = {
        "pitch": 5.5e-3,
        "sensor_width": 5.632,
        "object_distance": 250.0,
        "object_width": 150.0,
        "noise": SignalNoise(30.0),
    }
    return Setup(**(thesis | changed))


def thesis_design(profile="cosine") -> Design:
    """β 25 and 21 rad/mm², each with the phases 0 and 3π/2."""
    return shots([25.0, 21.0], 6.5, PAIR, wavelength=WAVELENGTH, width=WIDTH, profile=profile)


def two_betas(lower=8.0, upper=36.0) -> DesignSpace:
    variables = (Variable("beta", lower, upper, (0, 1)), Variable("beta", lower, upper, (2, 3)))
    return DesignSpace(thesis_design(), variables)


def error(design, data):
    """The Bayes error of pairs of two settings."""
    judged, frequencies = data
    return bayes_error(channels(design, judged, jnp.asarray(phase_pairs(2)), frequencies))
