"""ADMM-TV as a method that `drive` runs: residuals, and penalties that follow them."""

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thincam_jax.reconstruction.admm import (
    Penalties,
    Splitting,
    State,
    default_penalties,
    image_of,
    reflected,
    rescale,
    start,
    step,
)
from thincam_jax.reconstruction.drive import AbstractMethod, Residuals
from thincam_jax.reconstruction.problem import Deconvolution, objective


class AdmmTotalVariation(AbstractMethod[State]):
    """ADMM for a `Deconvolution`; see `thincam_jax.reconstruction.admm`.

    - `penalties`: to start with; default `default_penalties`.
    - `relaxation`: α, 0 < α < 2.
    """

    problem: Deconvolution
    splitting: Splitting
    penalties: Penalties
    relaxation: Float[Array, ""]

    def __init__(
        self, problem: Deconvolution, *, penalties: Penalties | None = None, relaxation=1.0
    ):
        self.problem = problem
        # The operators as they are: what comes out of a compiled function is a copy.
        self.splitting = eqx.tree_at(lambda s: s.operators, _split(problem), problem.operators)
        self.penalties = _default_penalties(self.splitting) if penalties is None else penalties
        self.relaxation = jnp.asarray(relaxation, problem.captures[0].dtype)

    def start(self, image):
        return _start(self.splitting, image)

    def advance(self, state, count):
        return _advance(self.splitting, self.penalties, self.relaxation, state, count)

    def image(self, state):
        return _image(self.splitting, state)

    def objective(self, image):
        return _objective(self.problem, image)

    def look(self, state):
        state, *numbers = step_and_residuals(self.splitting, self.penalties, self.relaxation, state)
        return state, as_residuals(numbers)

    def adapt(self, state, residuals):
        """Residual balancing: μ ← μ·√(primal/dual) of each split, by at most 3 at a time.

        Relative residuals are compared, as Wohlberg (arXiv:1704.06209) advises, so that the
        balance does not depend on units.
        """
        factors = [math.sqrt(_ratio(*part)) for part in residuals.parts]
        if all(1 / _ENOUGH < f < _ENOUGH for f in factors):
            return self, state
        wanted = Penalties(*(jnp.asarray(f, self.relaxation.dtype) for f in factors))
        penalties, state = _rescale(self.splitting, state, self.penalties, wanted)
        method = eqx.tree_at(lambda m: m.penalties, self, penalties)
        return method, state


_ENOUGH = 1.2


def as_residuals(numbers) -> Residuals:
    """What `step_and_residuals` gives beside the state, as plain numbers."""
    primal, dual, parts = jax.device_get(numbers)
    return Residuals(float(primal), float(dual), tuple((float(p), float(d)) for p, d in parts))


def _ratio(primal: float, dual: float) -> float:
    if not (primal > 0 and dual > 0):
        return 1.0
    return min(9.0, max(1 / 9.0, primal / dual))


_split = jax.jit(Splitting)
_default_penalties = jax.jit(default_penalties)
_start = jax.jit(start)
_image = jax.jit(image_of)
_objective = jax.jit(objective)
_rescale = jax.jit(rescale)


@functools.partial(jax.jit, static_argnames="count", donate_argnames="state")
def _advance(splitting, penalties, relaxation, state, count: int):
    for _ in range(count):
        state = step(splitting, penalties, relaxation, state)
    return state


@jax.jit
def step_and_residuals(splitting: Splitting, penalties: Penalties, relaxation, state: State):
    """A step, and its residuals: overall, and those of the three splits."""
    after = step(splitting, penalties, relaxation, state)
    old, new = (_consensus(splitting, penalties, s) for s in (state, after))
    gap = jax.tree.map(lambda b, a: (b - a) / relaxation, after, state)
    image = jax.tree.map(jnp.add, old, gap)  # K f
    size = [jnp.maximum(i, o) for i, o in zip(_sizes(image), _sizes(old), strict=True)]
    moved = _sizes(jax.tree.map(jnp.subtract, new, old))
    force = _sizes(jax.tree.map(jnp.subtract, after, new))
    weights = jnp.stack(jax.tree.leaves(penalties))
    gaps = jnp.stack(_sizes(gap))
    size, moved, force = (jnp.stack(x) for x in (size, moved, force))

    def over(a, b):
        return jnp.sqrt(jnp.where(b > 0, a / jnp.where(b > 0, b, 1), 0))

    parts = jnp.stack([over(gaps, size), over(moved, force)], axis=1)
    primal = over(weights @ gaps, weights @ size)
    dual = over(weights @ moved, weights @ force)
    return after, primal, dual, parts


def _consensus(splitting, penalties, state: State) -> State:
    """z of a state."""
    back = reflected(splitting, penalties, state)
    return jax.tree.map(lambda q, r: 0.5 * (q + r), state, back)


def _sizes(state: State) -> list[Float[Array, ""]]:
    """Squared norms of the three splits."""
    return [
        jnp.asarray(sum(jnp.sum(x**2) for x in jax.tree.leaves(part)))
        for part in (state.data, state.slopes, state.image)
    ]
