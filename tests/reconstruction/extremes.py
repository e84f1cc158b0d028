"""What every iterative method has to stand, in one place.

`solve(problem)` returns an `Outcome` after few iterations.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from reconstruction import scenes

import thincam_jax as tc


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


def check_recordings(solver):
    """Darkness, a pixel of NaN; single precision stays."""
    rng, shape = np.random.default_rng(4), (12, 13)
    psfs = tc.Psfs(jnp.asarray(rng.uniform(size=(1, 5, 4))))
    bright = jnp.asarray(rng.poisson(20.0, size=(1, *shape)).astype(float))
    ended = ("converged", "iterations_exhausted")
    for captures in (0 * bright, bright):
        found = tc.reconstruct(tc.Recording(captures, psfs), solver)
        assert found.status in ended and found.image.shape == shape
        assert bool(jnp.isfinite(found.image).all())
    single = tc.Psfs(psfs.psfs.astype(jnp.float32))
    found = tc.reconstruct(tc.Recording(bright.astype(jnp.float32), single), solver)
    assert found.image.dtype == jnp.float32
    broken = bright.at[0, 3, 4].set(jnp.nan)
    # Given so, it is refused; what is traced cannot be looked at.
    unseen = eqx.tree_at(
        lambda recording: recording.captures, tc.Recording(bright, psfs), (broken[0],)
    )
    assert tc.reconstruct(unseen, solver).status == "non_finite"
    masked = tc.Recording(broken, psfs, valid=jnp.isfinite(broken))
    assert tc.reconstruct(masked, solver).status in ended
