"""What every iterative method has to stand, in one place.

`solve(problem)` returns an `Outcome` after few iterations.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from reconstruction import scenes


def check_shapes(solve, **settings):
    """One and seven channels, planes, prime sizes; finite, right shape, something done."""
    for sensor, field, more in (
        ((13, 17), (11, 7), {"channels": 7}),
        ((7, 11), (5, 13), {"planes": 2, "batch": (2,)}),
    ):
        problem, _ = scenes.problem(sensor, field, captures=1, **more, **settings)
        outcome = solve(problem)
        assert outcome.image.shape == problem.image_shape
        assert bool(jnp.isfinite(outcome.image).all())
        assert outcome.status in ("converged", "iterations_exhausted")
        assert float(jnp.abs(outcome.image).max()) > 0


def check_darkness(solve, limit=0.0):
    """Captures of nothing give an image of nothing."""
    problem, _ = scenes.problem()
    dark = tuple(jnp.zeros_like(c) for c in problem.captures)
    outcome = solve(eqx.tree_at(lambda p: p.captures, problem, dark))
    assert outcome.status in ("converged", "iterations_exhausted")
    assert float(jnp.abs(outcome.image).max()) <= limit


def check_scale(solve, rtol=2e-3):
    """Captures of any brightness, in float32: the image goes with them."""
    problem = scenes.single(scenes.problem()[0])
    plain = solve(problem).image
    for factor in (1e-8, 1e8):
        outcome = solve(scenes.rescaled(problem, factor))
        assert outcome.image.dtype == jnp.float32
        difference = np.asarray(outcome.image) / factor - np.asarray(plain)
        assert np.abs(difference).max() < rtol * float(jnp.abs(plain).max())
