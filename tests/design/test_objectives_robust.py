"""Robust errors against samples of the errors they stand for."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from design.setting import setup, thesis_design

from thincam_jax.design import PowerLaw
from thincam_jax.design.design import Design
from thincam_jax.design.objectives import (
    Tolerances,
    bayes_error,
    channels,
    mismatch_error,
    robust_error,
)
from thincam_jax.design.setup import Polar
from thincam_jax.lensless.exposures import Exposures
from thincam_jax.reconstruction.synthesis import phase_pairs

SETUP = setup(object_width=180.0, prior=PowerLaw(2.8))
FREQUENCIES = Polar(jnp.asarray(200.0), 400, 2)
PAIRS = jnp.asarray(phase_pairs(2))
DESIGN = thesis_design()


@jax.jit
def known(design: Design):
    return channels(design, SETUP, PAIRS, FREQUENCIES)


nominal_error = jax.jit(bayes_error)
error_beside = jax.jit(mismatch_error)
compiled = eqx.filter_jit(robust_error)


def robust(tolerances, how="mean"):
    return float(compiled(DESIGN, SETUP, PAIRS, FREQUENCIES, tolerances, how=how))


@pytest.mark.thorough
@pytest.mark.parametrize("name, size", [("beta", 2e-4), ("distance", 2e-3)])
def test_the_mean_is_that_of_samples(name, size):
    """Errors of this size cost a few per cent of the error, where the second order is good."""
    rng = np.random.default_rng(2)
    nominal = known(DESIGN)

    @jax.jit
    def of(shift):
        moved = [DESIGN.beta, DESIGN.distance]
        index = ["beta", "distance"].index(name)
        moved[index] = moved[index] * (1 + shift) if name == "beta" else moved[index] + shift
        other = Design(
            Exposures(moved[0], moved[1], phase=DESIGN.phase, wavelength=5e-4, width=5.632)
        )
        return mismatch_error(nominal, known(other))

    # Both signs of each: what is odd in the errors cancels.
    draws = size * rng.normal(size=(100, 4))
    pairs = [(float(of(jnp.asarray(d))) + float(of(jnp.asarray(-d)))) / 2 for d in draws]
    exact = float(nominal_error(nominal))
    rise = robust(Tolerances(**{name: size})) - exact
    spread = np.std(pairs) / np.sqrt(len(pairs))
    assert rise > 5 * spread
    assert rise == pytest.approx(np.mean(pairs) - exact, rel=0.05, abs=3 * spread)


@pytest.mark.thorough
def test_the_worst_is_above_each_and_near_the_largest():
    tolerances = Tolerances(distance=0.02, wavelength=2e-6)
    nominal, errors = known(DESIGN), []
    for sign in (-1, 1):
        for k in range(4):
            moved = DESIGN.distance.at[k].add(sign * 0.02)
            other = Design(
                Exposures(DESIGN.beta, moved, phase=DESIGN.phase, wavelength=5e-4, width=5.632)
            )
            errors.append(float(error_beside(nominal, known(other))))
        other = Design(
            Exposures(
                DESIGN.beta,
                DESIGN.distance,
                phase=DESIGN.phase,
                wavelength=5e-4 + sign * 2e-6,
                width=5.632,
            )
        )
        errors.append(float(error_beside(nominal, known(other))))
    worst = robust(tolerances, "worst")
    assert max(errors) <= worst <= max(errors) + 0.04 * robust(Tolerances())


@pytest.mark.thorough
def test_a_tilt_counts_as_a_distance():
    tilt = 0.01
    depth = tilt * 5.632 / np.sqrt(12)
    nominal, errors = known(DESIGN), []
    for sign in (-1, 1):
        other = Design(
            Exposures(
                DESIGN.beta,
                DESIGN.distance + sign * depth,
                phase=DESIGN.phase,
                wavelength=5e-4,
                width=5.632,
            )
        )
        errors.append(float(error_beside(nominal, known(other))))
    assert robust(Tolerances(tilt=tilt)) == pytest.approx(np.mean(errors), rel=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize("how", ["worst", "mean"])
def test_gradient_by_differences(how):
    tolerances = Tolerances(
        beta=5e-4, distance=5e-3, wavelength=2e-6, object_distance=2.0, tilt=2e-3
    )

    @jax.jit
    def error(x):
        pairs = [jnp.repeat(v, 2) for v in (x[:2], x[2:4])]
        chosen = Design(
            Exposures(pairs[0], pairs[1], phase=DESIGN.phase, wavelength=x[4], width=x[5])
        )
        return robust_error(chosen, SETUP, PAIRS, FREQUENCIES, tolerances, how=how)

    place = jnp.array([25.0, 21.0, 6.3, 6.45, 5e-4, 5.6])
    slope = jax.jit(jax.grad(error))(place)
    for index, value in enumerate(place):
        step = jnp.zeros(6).at[index].set(1e-6 * value)
        difference = (error(place + step) - error(place - step)) / (2e-6 * value)
        assert float(slope[index] / difference) == pytest.approx(1, abs=1e-4)
