"""A small camera and its search problems, compiled in seconds, for the tests of searches.

48 pixels of 40 µm (Nyquist 12.5 cycles/mm) and masks of 2 mm at 3 mm, whose responses end at
βR/π = 8 cycles/mm; an object 60 mm wide at 100 mm.
"""

import jax.numpy as jnp
import numpy as np

from thincam_jax.design import (
    BayesError,
    DesignSpace,
    FrequencyCounts,
    PowerLaw,
    Setup,
    SignalNoise,
    Variable,
    design_problem,
    shots,
)
from thincam_jax.design.design import Design
from thincam_jax.design.problem import DesignProblem
from thincam_jax.design.space import Limits
from thincam_jax.reconstruction import phase_pairs

PAIR = (0.0, 1.5 * np.pi)
COUNTS = FrequencyCounts(radii=64, directions=1, exact=64)
BETAS = (Variable("beta", 12.0, 30.0, (0, 1)), Variable("beta", 12.0, 30.0, (2, 3)))


def pairs(betas=(25.0, 21.0), distance=3.0, width=2.0) -> Design:
    """A design of so many shots with two phases each."""
    return shots(list(betas), distance, PAIR, wavelength=5e-4, width=width)


def setup(**changed) -> Setup:
    numbers = {"pitch": 0.04, "sensor_width": 48 * 0.04, "object_distance": 100.0}
    more = {"object_width": 60.0, "noise": SignalNoise(30.0), "prior": PowerLaw(2.5)}
    return Setup(**(numbers | more | {"pixel_integration": False} | changed))


def problem(objective=None, variables=BETAS, base=None, limits=None, **changed) -> DesignProblem:
    """The search for both β, or for other numbers; `changed`: of the setup."""
    base = pairs() if base is None else base
    space = DesignSpace(base, tuple(variables), limits or Limits(captures=8))
    synthesis = phase_pairs(base.captures // 2)
    return design_problem(objective or BayesError(), space, setup(**changed), synthesis, COUNTS)


def shared(name, lower, upper, captures=4) -> Variable:
    """A number that all captures share."""
    return Variable(name, lower, upper, tuple(range(captures)))


def point_of(space, *values):
    """The point of a space's cube with these numbers."""
    return (jnp.asarray(values) - space.lower) / (space.upper - space.lower)
