r"""Ranking of the designs that a search or a training found, with their tolerances.

A scene 1 + m cos(2πν·θ) gives the sum of captures c a fringe of the amplitude m |Σ_k W_ck H_k(ν)|,
while the captures that it is made of hold the light Σ_k |W_ck| H_k(0). Their ratio is the contrast
with which the sum shows that of the scene,

.. math:: \mathrm{MTF}_c(\nu) = \frac{|\sum_k W_{ck} \bar H_k(\nu)|}{\sum_k |W_{ck}| H_k(0)}

At most 1; a single capture has 1 at zero frequency, and a difference of captures 0. A zone aperture
spreads each point over its whole shadow, so that some per mille are all there is.

The best linear reconstruction returns of each frequency the part

.. math:: \mathrm{MTF}(\nu) = \frac{S(\nu)}{1 + S(\nu)},\qquad S = \eta_f J

of what the scene holds (`thincam_jax.design.objectives`): the contrast of the whole chain. It holds
for the noise and the prior of the setup, on average over the object's points.
"""

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.arguments import checked
from thincam_jax.design.design import Design, Shot
from thincam_jax.design.objectives import ObjectiveData, channels, over_rings, ring_means
from thincam_jax.design.problem import DesignProblem, Objective
from thincam_jax.design.search import SEPARATION, Found, NonFiniteObjectiveError
from thincam_jax.design.sensitivity import FreeValue, derivatives, one_percent, with_tolerances
from thincam_jax.design.setup import Quadrant
from thincam_jax.design.space import DesignSpace
from thincam_jax.design.training_search import TrainedDesigns

RINGS = 64


@dataclass(frozen=True, eq=False)
class ModulationTransfer:
    """Contrast transfer against frequency, over rings of equal width up to the highest frequency.

    - `channels`: root mean square of MTF_c over each ring, for each sum of captures.
    - `chain`: mean of S/(1 + S) over each ring.
    - `sums`: captures that each sum adds and those that it subtracts, numbered from 1.
    """

    channels: np.ndarray
    chain: np.ndarray
    sums: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]


@checked
def modulation_transfer(design: Design, data: ObjectiveData) -> ModulationTransfer:
    """The contrast transfer of a design, by the exact response of the square aperture.

    `data`: with frequencies on a `Quadrant`. Channels are (channel, ring), the chain (ring,), both
    without unit. Valid as are the responses: Fresnel diffraction, centred masks.

    **Errors**: TypeError for frequencies on `Polar`, where the uniform background is left out.
    """
    if not isinstance(data.frequencies, Quadrant):
        raise TypeError("contrast is measured against the light at zero frequency; give a Quadrant")
    each, chain = _means(design, data)
    rows = np.asarray(data.synthesis)
    sums = tuple(
        (_numbers(row > 0), _numbers(row < 0)) if np.any(row > 0) else (_numbers(row < 0), ())
        for row in rows
    )
    return ModulationTransfer(np.asarray(each), np.asarray(chain), sums)


def _numbers(used: np.ndarray) -> tuple[int, ...]:
    return tuple(int(n) + 1 for n in np.flatnonzero(used))


@eqx.filter_jit
def _means(
    design: Design, data: ObjectiveData
) -> tuple[Float[Array, "channel ring"], Float[Array, " ring"]]:
    known = data.channels(design)
    # Each capture by itself, at zero frequency: all that its mask lets through.
    alone = jnp.eye(design.captures, dtype=data.synthesis.dtype)
    origin = Quadrant(data.frequencies.highest, 2)
    light = channels(design, data.setup, alone, origin).response[:, 0, 0]
    held = jnp.sum(jnp.abs(data.synthesis) * light, axis=1)
    contrast = known.response / held[:, None, None]
    ratio = known.signal_to_noise
    squared = jax.vmap(lambda c: over_rings(c**2, data.frequencies, RINGS))(contrast)
    return jnp.sqrt(squared), over_rings(ratio / (1 + ratio), data.frequencies, RINGS)


_KEPT = 10  # designs that are ranked


class RankedDesign(eqx.Module):
    """A design, its costs (smaller is better) in the search and exactly, and its ring means.

    - `level`: signal-to-noise ratio of each ring.
    - `values`, `status`, `active`: free numbers, end of the descent and active limits of a design
      found; empty for a reference.
    - `trained`: the error of the training images, with training.
    """

    name: str
    design: Design
    searched: float
    exact: float
    level: np.ndarray
    values: tuple[FreeValue, ...] = ()
    status: str = ""
    active: tuple[str, ...] = ()
    trained: float | None = None

    @property
    def shots(self) -> tuple[Shot, ...]:
        return self.design.shots


def rank_designs(problem: DesignProblem, found: tuple[Found, ...]) -> tuple[RankedDesign, ...]:
    """Designs of a search, ranked by the exact objective, with their tolerances.

    The first ten that differ in more than the order of their shots. `problem.data` are
    `ObjectiveData`.

    **Errors**: NonFiniteObjectiveError where nothing was found.
    """
    ranked = []
    for one in distinct_designs(problem.space, found):
        scored = score_design(problem, one.design)
        near = derivatives(problem.objective, problem.space, problem.best_data, one.point)
        increase = one_percent(problem.objective, scored.exact)
        values = with_tolerances(problem.space, one, near, increase).values
        ranked.append(replace(scored, values=values, status=one.status, active=one.active))
    return _named(sorted(ranked, key=lambda design: design.exact))


def rank_trained(problem: DesignProblem, trained: TrainedDesigns) -> tuple[RankedDesign, ...]:
    """Trained designs, ranked by their training error, with the tolerances of that."""
    space = problem.space
    near = {id(one): own for one, own in zip(trained.found, trained.near, strict=True)}
    ranked = []
    for one in distinct_designs(space, trained.found):
        point = jnp.asarray(np.asarray(one.point), space.lower.dtype)
        exact = replace(one, design=space.design(point), values=space.values(point), point=point)
        increase = one_percent(trained.objective, one.objective)
        values = with_tolerances(space, exact, near[id(one)], increase).values
        scored = replace(score_design(problem, exact.design), values=values, status=one.status)
        ranked.append(replace(scored, active=one.active, trained=one.objective))
    return _named(ranked)


def found_name(rank: int) -> str:
    """Name of the design of a rank, from 1."""
    return f"found {rank}"


def _named(ranked: Iterable[RankedDesign]) -> tuple[RankedDesign, ...]:
    return tuple(replace(one, name=found_name(k)) for k, one in enumerate(ranked, 1))


def distinct_designs(space: DesignSpace, found: tuple[Found, ...]) -> tuple[Found, ...]:
    """The first ten designs, without those whose shots are only in another order.

    **Errors**: NonFiniteObjectiveError where there is none.
    """
    if not found:
        raise NonFiniteObjectiveError(
            "the objective is NaN at any start; give bounds nearer to the reference"
        )
    kept: list[Found] = []
    for one in found:
        if not any(_alike(space, one, other) for other in kept):
            kept.append(one)
        if len(kept) == _KEPT:
            break
    return tuple(kept)


def _alike(space: DesignSpace, one: Found, other: Found) -> bool:
    """Whether two designs have the same shots, in whatever order."""
    spans = dict.fromkeys((field.name for field in fields(Shot)), 0.0)
    for v, lower, upper in zip(space.variables, space.lower, space.upper, strict=True):
        spans[v.name] = max(spans.get(v.name, 0.0), float(upper - lower))
    spans.pop("phase", None)
    pairs = zip(*(sorted(f.design.shots) for f in (one, other)), strict=True)
    return all(
        abs(getattr(a, name) - getattr(b, name)) <= SEPARATION * span
        for a, b in pairs
        for name, span in spans.items()
    )


@checked
def score_design(problem: DesignProblem, design: Design, name: str = "") -> RankedDesign:
    """Costs of a design in the search and exactly, and the signal-to-noise ratio of its rings."""
    searched, _ = _cost_and_rings(problem.objective, design, problem.data)
    exact, level = _cost_and_rings(problem.objective, design, problem.best_data)
    return RankedDesign(name, design, float(searched), float(exact), np.asarray(level))


@eqx.filter_jit
def _cost_and_rings(objective: Objective, design: Design, data: ObjectiveData):
    known = data.channels(design)
    return objective(design, data), ring_means(known, data.frequencies, RINGS)
