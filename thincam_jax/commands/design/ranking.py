"""The search, its designs ranked and re-scored exactly, and what surrounds them."""

from collections.abc import Iterable
from dataclasses import fields, replace
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from thincam_jax._core.precision import allow
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.design.config import DesignConfig, TrainingConfig, found_name
from thincam_jax.commands.design.problem import (
    RISE,
    DesignObjective,
    DesignProblem,
    ObjectiveData,
    Shot,
    build_problem,
    search_problem,
    shots_of_design,
)
from thincam_jax.commands.design.surroundings import (
    FreeValue,
    Landscape,
    derivatives,
    free_values,
    landscape_of,
)
from thincam_jax.commands.design.train import Trained, TrainingDescents
from thincam_jax.commands.design.transfer import RINGS, Transfer, modulation_transfer
from thincam_jax.commands.run_folder import Step
from thincam_jax.commands.study.build import FileStudy
from thincam_jax.design import Design, DesignSpace, channels
from thincam_jax.design.objectives import ring_means
from thincam_jax.design.search import APART, Found, Search

_KEPT = 10  # designs that are re-scored and listed


class Candidate(eqx.Module):
    """A design, its objective (smaller is better) as searched and exactly, and its ring means.

    - `level`: signal-to-noise ratio of each ring.
    - `values`, `status`, `active`: of what was found; empty for the reference.
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
        return shots_of_design(self.design)


class FoundDesigns(eqx.Module):
    """What a search gave.

    - `edge`: of the frequencies looked at, cycles/rad.
    - `transfers`: the modulation transfer of the reference and of the best design.
    - `training`: what the training gave; None without.
    """

    objective: DesignObjective
    reference: Candidate
    found: tuple[Candidate, ...]
    evaluations: int
    failed: int
    exponent: float
    edge: float
    landscape: Landscape | None
    transfers: tuple[Transfer, Transfer] | None = None
    training: Trained | None = None


class Finder:
    """The search of a design's file: its list of work, which ends with the `result`.

    In double precision: the objective's fringes are finer than single holds. Training, which is not
    that fine, is in the precision that JAX is set to.
    """

    problem: DesignProblem
    searched: Search
    kept: tuple[Found, ...]
    descents: TrainingDescents
    trained: Trained | None = None
    found: tuple[Candidate, ...]
    result: FoundDesigns

    def __init__(self, study: FileStudy):
        self.study = study
        self.config: DesignConfig = study.config
        self.work = [Step("search", self.search)]
        if (wanted := self.config.train) is not None:
            self.work.append(Step("training, samples", partial(self.sample, wanted)))
            for number in range(wanted.starts):
                text = f"training {number + 1} of {wanted.starts}"
                self.work.append(Step(text, lambda n=number: self.descents.descend(n)))
            self.work.append(Step("around the trained designs", self.finish_training))
        self.work += [Step("found designs", self.rank), Step("landscape", self.surround)]

    def search(self) -> None:
        with allow("float64"):
            self.problem = build_problem(self.study)
            given = (self.problem, self.config.search, self.config.seed)
            self.searched = search_problem(*given, exact=self.problem.exact)
            self.kept = distinct(self.problem.space, self.searched.found)

    def sample(self, wanted: TrainingConfig) -> None:
        points = [np.asarray(one.point) for one in self.kept]
        setup = self.problem.data.setup
        self.descents = TrainingDescents(self.config, wanted, setup, points)

    def finish_training(self) -> None:
        self.trained = self.descents.finish()

    def rank(self) -> None:
        with allow("float64"):
            if self.trained is None:
                self.found = rescored(self.problem, self.kept)
            else:
                self.found = rank_trained(self.problem, self.trained)

    def surround(self) -> None:
        problem, base, best = self.problem, self.problem.space.base, self.found[0].design
        with allow("float64"):
            reference = Candidate(self.config.reference.name, base, *_score(problem, base))
            if self.trained is not None:
                reference = replace(reference, trained=self.trained.reference)
            given = (problem.objective, problem.space, problem.data)
            self.result = FoundDesigns(
                problem.objective,
                reference,
                self.found,
                self.searched.evaluations,
                self.searched.failed,
                float(problem.data.setup.prior.exponent),
                float(problem.data.frequencies.highest),
                landscape_of(*given, best, self.config.search.grid),
                (
                    modulation_transfer(base, problem.exact),
                    modulation_transfer(best, problem.exact),
                ),
                self.trained,
            )


def distinct(space: DesignSpace, found: tuple[Found, ...]) -> tuple[Found, ...]:
    """The best, without those whose shots are only in another order.

    **Errors**: ConfigError where the objective was NaN at every start.
    """
    if not found:
        raise ConfigError(
            "search: the objective is NaN at any start; give bounds nearer to the reference"
        )
    kept: list[Found] = []
    for one in found:
        if not any(_alike(space, one, other) for other in kept):
            kept.append(one)
        if len(kept) == _KEPT:
            break
    return tuple(kept)


def rescored(problem: DesignProblem, kept: tuple[Found, ...]) -> tuple[Candidate, ...]:
    """The search's designs, ranked exactly."""
    candidates = []
    for one in kept:
        unmeasured = _candidate(problem, one, ())
        candidates.append(replace(unmeasured, values=tolerances(problem, one, unmeasured.exact)))
    return _named(sorted(candidates, key=lambda candidate: candidate.exact))


def rank_trained(problem: DesignProblem, trained: Trained) -> tuple[Candidate, ...]:
    """The trained designs, by their training error."""
    space = problem.space
    near = {id(one): own for one, own in zip(trained.found, trained.near, strict=True)}
    candidates = []
    for one in distinct(space, trained.found):
        point = jnp.asarray(np.asarray(one.point), space.lower.dtype)
        exact = replace(one, design=space.design(point), values=space.values(point), point=point)
        values = free_values(space, exact, near[id(one)], RISE * one.objective)
        candidates.append(replace(_candidate(problem, exact, values), trained=one.objective))
    return _named(candidates)


def _candidate(problem: DesignProblem, one: Found, values: tuple[FreeValue, ...]) -> Candidate:
    return Candidate("", one.design, *_score(problem, one.design), values, one.status, one.active)


def _named(candidates: Iterable[Candidate]) -> tuple[Candidate, ...]:
    return tuple(replace(c, name=found_name(k)) for k, c in enumerate(candidates, 1))


def _alike(space: DesignSpace, one: Found, other: Found) -> bool:
    """Whether two designs have the same shots, in whatever order."""
    spans = dict.fromkeys((field.name for field in fields(Shot)), 0.0)
    for v, lower, upper in zip(space.variables, space.lower, space.upper, strict=True):
        spans[v.name] = max(spans[v.name], float(upper - lower))
    pairs = zip(*(sorted(shots_of_design(f.design)) for f in (one, other)), strict=True)
    return all(
        abs(getattr(a, name) - getattr(b, name)) <= APART * span
        for a, b in pairs
        for name, span in spans.items()
    )


def _score(problem: DesignProblem, design: Design) -> tuple[float, float, np.ndarray]:
    """The objective as searched, exactly, and the signal-to-noise ratio of the rings."""
    searched, _ = _value_and_rings(problem.objective, design, problem.data)
    exact, level = _value_and_rings(problem.objective, design, problem.exact)
    return float(searched), float(exact), np.asarray(level)


@eqx.filter_jit
def _value_and_rings(objective: DesignObjective, design: Design, data: ObjectiveData):
    known = channels(design, data.setup, data.synthesis, data.frequencies)
    return objective(design, data), ring_means(known, data.frequencies, RINGS)


def tolerances(problem: DesignProblem, one: Found, exact: float) -> tuple[FreeValue, ...]:
    """The free numbers, each with the change that makes the objective, `exact`, worse by 1 %."""
    near = derivatives(problem.objective, problem.space, problem.exact, one.point)
    return free_values(problem.space, one, near, problem.objective.rise(exact))
