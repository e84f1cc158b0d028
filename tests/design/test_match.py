"""Least squares to a target response: designs found again, and what none gives is said."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from design.setting import setup, two_betas

from thincam_jax.design import PowerLaw
from thincam_jax.design.match import MatchSettings, ResponseModel, match_response
from thincam_jax.design.setup import Polar
from thincam_jax.reconstruction import phase_pairs

RINGS = 16
DATA = (setup(prior=PowerLaw(2.8)), jnp.asarray(phase_pairs(2)), Polar(96.0, 128, 2))
SPACE = two_betas()
MODEL = ResponseModel(SPACE, *DATA, RINGS)
POINT = jnp.array([0.61, 0.27])


@functools.cache
def wanted():
    return MODEL.levels(POINT)


def match(target=None, seed=0, model=MODEL, **options):
    settings = MatchSettings(**{"starts": 4, "samples": 64} | options)
    target = wanted() if target is None else target
    return match_response(model, target, settings, key=jax.random.key(seed))


@pytest.mark.thorough
def test_design_is_found_from_its_response():
    """β to 0.01 rad/mm² of 28, in either order of the pairs."""
    result = match()
    best = result.found[0]
    np.testing.assert_allclose(jnp.sort(best.values), jnp.sort(SPACE.values(POINT)), atol=0.01)
    assert (result.status, result.failed, best.active) == ("matched", 0, ())
    assert result.misfit_db == best.objective < 0.01
    np.testing.assert_allclose(MODEL.misfit(best.point, wanted()), best.objective, atol=1e-9)
    assert 64 < result.evaluations <= 64 + 4 * 31


@pytest.mark.thorough
def test_descents_are_better_than_samples():
    """Of a target that no design fulfils, too: and this is told."""
    result = match(jnp.full(RINGS, 30.0))
    points = jnp.stack(jnp.meshgrid(*[jnp.linspace(0.0, 1.0, 9)] * 2), -1).reshape(-1, 2)
    misfits = jax.lax.map(lambda p: MODEL.misfit(p, jnp.full(RINGS, 30.0)), points)
    assert result.status == "not_attained"
    assert 5.0 < result.misfit_db < float(jnp.min(misfits))
    assert match(tolerance_db=30.0).status == "matched"
