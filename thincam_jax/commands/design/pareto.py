"""Pareto fronts of designs: what thickness, captures and light buy.

Every point of a front is a search of its own over all that is free: from even samples, and once
more near the best design of each point beside it. The design that costs less competes itself, too,
so that what costs more is never worse for want of searching. Designs are compared by the exact
response, all of them on one band of frequencies.
"""

import dataclasses
import math
from collections.abc import Iterable
from functools import cached_property, partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.precision import allow
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.design import problem as problems
from thincam_jax.commands.design.config import DesignConfig, found_name
from thincam_jax.commands.design.config_pareto import ParetoConfig, with_shots
from thincam_jax.commands.design.simulation import simulate, with_designs
from thincam_jax.commands.run_folder import Step
from thincam_jax.commands.study.build import FileStudy
from thincam_jax.design import Design, DesignSpace, PhotonNoise, bayes_error, channels, limit

_TRIED = 3  # of the designs of a search, are scored exactly
_NEAR = 0.15  # of the search's bounds to either side, where a search goes on from the point before
_TOLD = {
    "thickness": "thickness {:.3g} mm",
    "captures": "{:g} captures",
    "light": "light {:.4g} electrons",
}


class FrontPoint(eqx.Module):
    """The best design found at one cost.

    - `cost`: the thickness allowed, mm; how many captures; or electrons from each mm² of open
      aperture.
    - `resolution`: cycles/rad, up to which every ring's signal-to-noise ratio is at least 1.
    - `ends`: what ends it other than the signal, in words; empty where nothing does.
    - `error`: of the best linear reconstruction, as a part of the scene's variance.
    - `simulated`: PSNR of each picture, dB, where it was asked for.
    """

    cost: float
    design: Design
    resolution: float
    ends: str
    error: float
    simulated: tuple[tuple[str, float | None], ...] = ()

    @property
    def shots(self) -> tuple[problems.Shot, ...]:
        return problems.shots_of_design(self.design)


class Front(eqx.Module):
    """The points in the order of their cost, and the design to beat at its own."""

    points: tuple[FrontPoint, ...]
    reference: FrontPoint


class Fronts(eqx.Module):
    """Those that were asked for: thickness, captures, light.

    - `edge`: the highest frequency of all, cycles/rad.
    - `picture_variance`: geometric mean over the pictures, whose values end at 1; of captures.
    """

    fronts: dict[str, Front]
    edge: float
    picture_variance: float | None


class FrontSearches:
    """The fronts that a design's file asks for: their list of work, and what it results in.

    A point of thickness or light is searched for by itself; then near the next, from the last on;
    then near the one before. Captures share the reference's exposure time; each number of them is
    searched for by itself and near the one before. Double precision, as in `Finder`.

    **Errors**: ConfigError where the objective was NaN at every start.
    """

    def __init__(self, study: FileStudy, asked: ParetoConfig):
        self.study, self.asked = study, asked
        self.config: DesignConfig = study.config
        self.phases = len(self.config.reference.phases)
        self.costs = asked.costs(self.phases)
        self.best: dict[str, dict[int, FrontPoint]] = {name: {} for name in self.costs}
        self.work: list[Step] = []
        for name, costs in self.costs.items():
            for place, beside in _order(name, len(costs)):
                search = partial(self.search, name, place, beside)
                self.work.append(Step(_TOLD[name].format(costs[place]), search))
        for place, cost in enumerate(self.costs.get("captures", ())):
            self.work.append(Step(f"{cost:g} captures, simulated", partial(self.simulate, place)))

    @cached_property
    def problem(self) -> problems.DesignProblem:
        """On the frequencies of the reference, which all points share."""
        return problems.build_problem(self.study)

    def search(self, name: str, place: int, beside: int | None) -> None:
        """A point of a front, near that of another place or over the whole space."""
        cost, best = self.costs[name][place], self.best[name]
        with allow("float64"):
            problem = self._problem(name, cost)
            near = None if beside is None else best[beside].design
            if near is not None and name == "captures":
                near = _longer(near, problem.space.base)
            best[place] = dataclasses.replace(self._best(problem, near, best.get(place)), cost=cost)

    def _problem(self, name: str, cost: float) -> problems.DesignProblem:
        if name == "captures":
            return _of_shots(self.config, self.problem, round(cost) // self.phases)
        given = dataclasses.replace(self.problem, objective=problems.DesignObjective("limit"))
        if name == "light":
            return _lit(given, cost)
        is_distance = jnp.asarray([v.name == "distance" for v in given.space.variables])
        upper = given.space.upper
        thin = jnp.where(is_distance, jnp.minimum(upper, cost), upper)
        return dataclasses.replace(given, space=eqx.tree_at(lambda s: s.upper, given.space, thin))

    def _best(
        self, problem: problems.DesignProblem, near: Design | None, own: FrontPoint | None
    ) -> FrontPoint:
        """The best of a search near another design, of that design, and of `own`.

        Without `own`, of a search over the whole space, too.
        """
        spaces = [problem.space] if own is None else []
        designs: list[Design] = []
        if near is not None:
            place = jnp.clip(problem.space.point(near), 0.0, 1.0)
            spaces.append(_near(problem.space, place))
            designs.append(problem.space.design(place))
        for space in spaces:
            searched = problems.search_problem(
                dataclasses.replace(problem, space=space), self.asked, self.config.seed
            )
            designs += [found.design for found in searched.found[:_TRIED]]
        judged = [_judge(design, problem.exact) for design in designs]
        judged = _known(judged if own is None else [own, *judged])
        if problem.objective.name == "limit":
            return min(judged, key=lambda j: (-j.resolution, j.error))
        return min(judged, key=lambda j: j.error)

    def simulate(self, place: int) -> None:
        """PSNR of every picture in the full simulation, at the seed of the configuration."""
        point, name = self.best["captures"][place], found_name(1)
        study = with_designs(dataclasses.replace(self.study, methods=()), {name: point.design})
        simulated = tuple(
            (target.name, simulate(study, target, 1)[name][0]["psnr_db"])
            for target in study.targets
            if target.is_picture
        )
        self.best["captures"][place] = dataclasses.replace(point, simulated=simulated)

    def result(self) -> Fronts:
        """When all work is done."""
        costs = {
            "thickness": max(shot.distance for shot in self.config.reference.shots),
            "captures": float(self.problem.space.base.captures),
            "light": self.config.noise.electrons or 0.0,
        }
        with allow("float64"):
            reference = _judge(self.problem.space.base, self.problem.exact)
        fronts = {
            name: Front(
                tuple(best[n] for n in sorted(best)),
                dataclasses.replace(reference, cost=costs[name]),
            )
            for name, best in self.best.items()
        }
        variance = _variance(self.study) if "captures" in fronts else None
        return Fronts(fronts, float(self.problem.exact.frequencies.highest), variance)


def _order(name: str, count: int) -> list[tuple[int, int | None]]:
    """In which order the points of a front are searched for, each beside which other one."""
    if name == "captures":
        return [(n, n - 1 if n else None) for n in range(count)]
    alone = [(n, None) for n in range(count)]
    back = [(n, n + 1) for n in reversed(range(count - 1))]
    return [*alone, *back, *((n, n - 1) for n in range(1, count))]


def _variance(study: FileStudy) -> float:
    planes = (target.plane for target in study.targets if target.is_picture)
    images = (np.asarray(plane.image, dtype=float) for plane in planes)
    return float(np.exp(np.mean([np.log(np.mean(np.var(i, axis=(-2, -1)))) for i in images])))


def _of_shots(
    config: DesignConfig, problem: problems.DesignProblem, count: int
) -> problems.DesignProblem:
    """The search for designs of so many shots, on the frequencies of the others.

    With noise that counts electrons they divide the exposure of the reference's captures evenly.
    """
    space = with_shots(config, count).space()
    matrix = jnp.asarray(problems.synthesis_of(space.base, config), float)
    if config.noise.electrons is not None:
        captures = space.base.captures
        share = jnp.full(captures, problem.space.base.captures / captures, space.lower.dtype)
        space = eqx.tree_at(lambda s: s.base.exposure, space, share)
    return problems.DesignProblem(
        problems.DesignObjective("bayes_error"),
        space,
        dataclasses.replace(problem.data, synthesis=matrix),
        dataclasses.replace(problem.exact, synthesis=matrix),
    )


def _lit(problem: problems.DesignProblem, electrons: float) -> problems.DesignProblem:
    """With so many electrons."""

    def lit(data: problems.ObjectiveData) -> problems.ObjectiveData:
        noise = data.setup.noise
        assert isinstance(noise, PhotonNoise)  # for the type checker; the file was checked
        number = jnp.asarray(electrons, noise.electrons.dtype)
        return dataclasses.replace(
            data,
            setup=eqx.tree_at(lambda s: s.noise.electrons, data.setup, number),
        )

    return dataclasses.replace(problem, data=lit(problem.data), exact=lit(problem.exact))


def _longer(design: Design, base: Design) -> Design:
    """A design with its last shot taken again, as often as `base` has captures more."""
    phases = problems.phases_of(base)
    last = range(design.captures - phases, design.captures)
    more = (base.captures - design.captures) // phases
    order = jnp.asarray([*range(design.captures), *(list(last) * more)])
    return eqx.tree_at(
        lambda d: (d.beta, d.distance, d.wavelength, d.width),
        base,
        (design.beta[order], design.distance[order], design.wavelength[order], design.width),
    )


def _known(judged: Iterable[FrontPoint]) -> list[FrontPoint]:
    known = [j for j in judged if np.isfinite(j.error)]
    if not known:
        raise ConfigError(
            "pareto: the objective is NaN at any start; give bounds nearer to the reference"
        )
    return known


def _near(space: DesignSpace, place: Float[Array, " variable"]) -> DesignSpace:
    """What of a space lies near a place, without another compilation.

    Of β, which a mask's pixels tie to the width, the lowest of the widest masks and the highest of
    the narrowest: what it then may have with a width is for the space to say.
    """
    is_width = jnp.asarray([v.name == "width" for v in space.variables])
    step = jnp.where(is_width, -_NEAR, _NEAR).astype(place.dtype)
    less, more = (space.values(jnp.clip(place + s, 0.0, 1.0)) for s in (-step, step))
    lower, upper = jnp.where(is_width, more, less), jnp.where(is_width, less, more)
    return eqx.tree_at(lambda s: (s.lower, s.upper), space, (lower, upper))


def _judge(design: Design, data: problems.ObjectiveData) -> FrontPoint:
    """Resolution and error by the exact response; no resolution beyond what the pixels sample."""
    found, error = (float(value) for value in _exactly(design, data))
    edge = float(data.frequencies.highest)
    nyquist = float(jnp.max(design.distance)) / (2 * float(data.setup.pitch))
    ends = "at the band's end" if found >= edge * (1 - 1e-9) else ""
    if nyquist < min(found, edge):
        ends = "at the pixels' Nyquist frequency"
    return FrontPoint(math.nan, design, min(found, edge, nyquist), ends, error)


@eqx.filter_jit
def _exactly(
    design: Design, data: problems.ObjectiveData
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    known = channels(design, data.setup, data.synthesis, data.frequencies)
    return limit(known, data.frequencies), bayes_error(known)
