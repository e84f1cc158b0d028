r"""A design for a target response, from a network and two Gauss–Newton steps.

The network maps target levels (`thincam_jax.design.match`) to points p of a space's unit
cube. The map has many values: captures may be exchanged, and different designs have like responses.
So it gives several guesses; two Gauss–Newton steps refine each within the cube,

.. math:: \Delta p = -(J^T J + \mu\,\mathrm{diag}\,J^T J)^{-1} J^T
    [L(p) - L^{target}], \qquad J = \partial L/\partial p

with the best of several dampings μ; and the best of what comes out is the answer. The response
model judges every guess, so the misfit that is reported is the design's, not the network's opinion.
"""

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Numbers
from thincam_jax._core.module import Module
from thincam_jax.design.design import Design
from thincam_jax.design.match import (
    MATCHED,
    MatchStatus,
    ResponseModel,
    checked_levels,
    match_status,
    root_mean_square,
)
from thincam_jax.design.space import active_limits
from thincam_jax.learn.checkpoint import (
    CheckpointError,
    read_description,
    read_weights,
    write_arrays,
)

STEPS = 2
# Parts of the diagonal of JᵀJ that are tried beside each other in every step. Ripples of the
# response make the widest steps useless where the linear model reaches a fringe only.
_DAMPINGS = (0.01, 0.3, 10.0)


@checked
class Suggester(eqx.Module):
    """A network from target levels to guesses in the unit cube, and the model that judges them.

    - `layers`: layers of a multilayer perceptron, SiLU between them, a sigmoid at the end.
    - `mean`, `scale`: mean and scale of the levels it was trained on, dB; it sees (target −
      mean)/scale.
    - `model`: space, setup, synthesis and frequencies it was trained for.
    - `guesses`: how many points it gives.

    `train_suggester` makes one; as initialised its guesses mean nothing.
    """

    layers: tuple[eqx.nn.Linear, ...]
    mean: Float[Array, " ring"]
    scale: Float[Array, " ring"]
    model: ResponseModel
    guesses: int = eqx.field(static=True)

    def __init__(
        self, model: ResponseModel, *, key: PRNGKeyArray, guesses: int, width: int, depth: int
    ):
        checks.at_least_one({"guesses": guesses, "width": width, "depth": depth})
        dtype = model.space.lower.dtype
        sizes = (model.rings, *[width] * depth, guesses * model.space.size)
        keys = jax.random.split(key, depth + 1)
        self.layers = tuple(
            eqx.nn.Linear(a, b, dtype=dtype, key=k)
            for a, b, k in zip(sizes[:-1], sizes[1:], keys, strict=True)
        )
        self.mean, self.scale = jnp.zeros(model.rings, dtype), jnp.ones(model.rings, dtype)
        self.model, self.guesses = model, guesses

    def __call__(self, target: Float[Array, " ring"]) -> Float[Array, "guess variable"]:
        """The network alone: points of the unit cube."""
        signal = (target - self.mean) / self.scale
        for layer in self.layers[:-1]:
            signal = jax.nn.silu(layer(signal))
        return jax.nn.sigmoid(self.layers[-1](signal)).reshape(self.guesses, -1)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write a trained suggester with its camera; whole or not at all."""
        return write_arrays(path, self, _described(self))

    @classmethod
    @checked
    def load(cls, path: str | os.PathLike[str], model: ResponseModel) -> "Suggester":
        """Read a suggester that was trained for the space and camera of `model`.

        **Errors**: CheckpointError (a ValueError), one line, for a file that is none or is damaged,
        and for one that was trained for another space, camera, synthesis or frequencies, with the
        first number that differs.
        """
        there = read_description(path)
        if there.get("kind") != _KIND:
            raise CheckpointError(f"{path} is no suggester; give a file that Suggester.save wrote")
        fresh = cls(model, key=jax.random.key(0), **there["network"])
        for name, here in json.loads(json.dumps(_described(fresh))).items():
            if there.get(name) != here:
                raise CheckpointError(
                    f"{path} was trained for other {name}: {json.dumps(there.get(name))}, and here "
                    f"they are {json.dumps(here)}; train a suggester for these"
                )
        loaded = read_weights(path, fresh)
        _check_numbers(path, loaded.model, model)
        return loaded


class Proposal(eqx.Module):
    """Result of `propose`: points of the unit cube and their misfits, dB.

    - `first_point`, `first_misfit_db`: the best guess of the network alone.
    - `point`, `misfit_db`: after the Gauss–Newton steps; never worse.
    - `levels`: that the design at `point` gives, dB.
    """

    first_point: Float[Array, " variable"]
    first_misfit_db: Float[Array, ""]
    point: Float[Array, " variable"]
    misfit_db: Float[Array, ""]
    levels: Float[Array, " ring"]


@jax.jit
def propose(suggester: Suggester, target: Float[Array, " ring"]) -> Proposal:
    """The answer without words: compiled once for all target levels, for `jit`, `vmap`, `grad`."""
    model = suggester.model
    points = suggester(target)
    refined, first = refine(model, target, points)
    levels = jax.vmap(model.levels)(refined)
    misfits = jax.vmap(root_mean_square)(levels - target)
    at_first, best = (jnp.argmin(_or_infinite(m)) for m in (first, misfits))
    return Proposal(points[at_first], first[at_first], refined[best], misfits[best], levels[best])


def refine(
    model: ResponseModel,
    target: Float[Array, " ring"],
    points: Float[Array, "guess variable"],
    steps: int = STEPS,
) -> tuple[Float[Array, "guess variable"], Float[Array, " guess"]]:
    """Points after some Gauss–Newton steps in the cube, and their misfits before, dB."""

    def step(points, _):
        return jax.vmap(_newton_step, in_axes=(None, None, 0))(model, target, points)

    # One step after the other as a loop: written out, each would be compiled.
    refined, misfits = jax.lax.scan(step, points, length=steps)
    return refined, misfits[0]


def _newton_step(
    model: ResponseModel, target: Float[Array, " ring"], point: Float[Array, " variable"]
) -> tuple[Float[Array, " variable"], Float[Array, ""]]:
    """The best of some damped Gauss–Newton steps within the cube, or none; the misfit before."""

    def residual(p):
        difference = model.levels(p) - target
        return difference, difference

    slopes, difference = jax.jacfwd(residual, has_aux=True)(point)
    gradient = slopes.T @ difference
    # What lies on a face and would leave the cube stays where it is.
    held = ((point <= 0) & (gradient > 0)) | ((point >= 1) & (gradient < 0))
    slopes = jnp.where(held, 0.0, slopes)
    curvature, gradient = slopes.T @ slopes, jnp.where(held, 0.0, gradient)
    size = jnp.diagonal(curvature)
    size = jnp.where(size > 0, size, 1.0)

    def damped(damping):
        step = jnp.linalg.solve(curvature + jnp.diag(damping * size), gradient)
        return jnp.clip(point - step, 0.0, 1.0)

    tried = jax.vmap(damped)(jnp.asarray(_DAMPINGS, point.dtype))
    misfits = jax.vmap(model.misfit, in_axes=(0, None))(tried, target)
    here = root_mean_square(difference)
    best = jnp.argmin(_or_infinite(misfits))
    return jnp.where(misfits[best] < here, tried[best], point), here


def _or_infinite(misfits: Float[Array, " point"]) -> Float[Array, " point"]:
    return jnp.where(jnp.isfinite(misfits), misfits, jnp.inf)


class Suggestion(Module):
    """A design for a target response.

    - `design`; `values`: its free numbers, in the order of the space's variables.
    - `misfit_db`: root mean square over the rings of what its levels differ from the target, dB.
    - `network_misfit_db`: misfit of the network's best guess, before the Gauss–Newton steps.
    - `levels`: levels that the design gives, dB.
    - `active`: the limits it lies against, in words.
    - `status`: "matched" within the tolerance; "not_attained": no design was found that gives
      the target, and there may be none; "non_finite": no guess has a response.
    - `point`: in the unit cube.
    """

    design: Design
    values: Float[Array, " variable"]
    misfit_db: float
    network_misfit_db: float
    levels: Float[Array, " ring"]
    active: tuple[str, ...]
    status: MatchStatus
    point: Float[Array, " variable"]


@checked
def suggest(suggester: Suggester, target: Numbers, *, tolerance_db: float = MATCHED) -> Suggestion:
    """A design whose levels are near to target ones, in some tens of milliseconds once compiled.

    **Arguments**

    - `target`: levels in dB, one for each ring from zero frequency up (`ring_levels`), at least 0.
    - `tolerance_db`: misfits up to here are "matched".

    **Validity.** For the camera and the space that the suggester was trained for. It is one of the
    designs that fit, not the best of all: `match_response` looks for that.

    **Errors**: ValueError for another number of levels, and for levels not finite or below 0.
    """
    model = suggester.model
    levels = checked_levels(target, model.rings, model.space.lower.dtype)
    found = propose(suggester, levels)
    misfit, network = float(found.misfit_db), float(found.first_misfit_db)
    return Suggestion(
        model.space.design(found.point),
        model.space.values(found.point),
        misfit,
        network,
        found.levels,
        active_limits(model.space, found.point),
        match_status(misfit, tolerance_db),
        found.point,
    )


_KIND = "suggester"


def _described(suggester: Suggester) -> dict[str, Any]:
    """Description that must agree before the numbers can be read."""
    model, layers = suggester.model, suggester.layers
    space, setup = model.space, model.setup
    width, depth = layers[0].out_features, len(layers) - 1
    kinds = (type(part).__name__ for part in (setup.noise, model.frequencies))
    return {
        "kind": _KIND,
        "rings": model.rings,
        "network": {"guesses": suggester.guesses, "width": width, "depth": depth},
        "variables": [asdict(v) for v in space.variables],
        "limits": asdict(space.limits),
        "captures": [space.base.captures, space.base.profile],
        "models": [*kinds, setup.pixel_integration, setup.crop],
    }


def _check_numbers(path, trained: ResponseModel, given: ResponseModel) -> None:
    """A suggester answers for the camera that it was trained for, and for no other."""
    leaves = jax.tree_util.tree_flatten_with_path(trained)[0]
    for (keys, there), here in zip(leaves, jax.tree.leaves(given), strict=True):
        same = np.isclose(there, here, rtol=1e-5, atol=0.0)
        if not same.all():
            at = np.unravel_index(np.argmin(same), here.shape)
            name = jax.tree_util.keystr(keys).lstrip(".")
            raise CheckpointError(
                f"{path} was trained for another camera: {name} was {float(there[at]):.6g} and is "
                f"{float(here[at]):.6g}; train a suggester for this one"
            )
