"""Pareto fronts of designs: what thickness, captures and light buy.

Every point of a front is a search of its own over all that is free: from even samples, and once
more near the best design of each point beside it. The design that costs less competes itself, too,
so that what costs more is never worse for want of searching. Designs are compared by the exact
response, all of them on one band of frequencies.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.precision import allow
from thincam_jax.commands.design.config import DesignConfig, found_name
from thincam_jax.commands.design.config_pareto import ParetoConfig, with_shots
from thincam_jax.commands.design.problem import Data, Goal, Problem, build_problem, search_problem
from thincam_jax.commands.design.ranking import Shot, shots_of_design
from thincam_jax.commands.design.simulate import simulate
from thincam_jax.commands.design.simulated import build_study
from thincam_jax.commands.study.build import build_plane, synthesis_matrix
from thincam_jax.commands.study.config import ConfigError
from thincam_jax.commands.study.target import Progress
from thincam_jax.design import Design, DesignSpace, PhotonNoise, bayes_error, channels, limit

_TRIED = 3  # of the designs of a search, are scored exactly
_NEAR = 0.15  # of the search's bounds to either side, where a search goes on from the point before


class Point(NamedTuple):
    """The best design found at one cost.

    - `cost`: the thickness allowed, mm; how many captures; or electrons from each mm² of open
      aperture.
    - `shots`: its β and distances.
    - `resolution`: cycles/rad, up to which every ring's signal-to-noise ratio is at least 1.
    - `ends`: what ends it other than the signal, in words; empty where nothing does.
    - `error`: of the best linear reconstruction, as a part of the scene's variance.
    - `simulated`: PSNR of each picture, dB, where it was asked for.
    """

    cost: float
    shots: tuple[Shot, ...]
    resolution: float
    ends: str
    error: float
    simulated: tuple[tuple[str, float | None], ...] = ()


class Front(NamedTuple):
    """The points in the order of their cost, and the design to beat at its own."""

    points: tuple[Point, ...]
    reference: Point


class Fronts(NamedTuple):
    """Those that were asked for.

    - `edge`: the highest frequency of all, cycles/rad.
    - `picture_variance`: geometric mean over the pictures, whose values end at 1.
    """

    thickness: Front | None
    captures: Front | None
    light: Front | None
    edge: float
    picture_variance: float | None


class _Judged(NamedTuple):
    design: Design
    resolution: float
    ends: str
    error: float


def pareto_steps(fronts: ParetoConfig | None) -> int:
    """How many times `find_fronts` reports progress."""
    if fronts is None:
        return 0
    # There, back and there again, see `_line`.
    lines = [3 * f.points - 2 for f in (fronts.thickness, fronts.light) if f is not None]
    return sum(lines) + (2 * len(fronts.captures.shots) if fronts.captures is not None else 0)


def find_fronts(config: DesignConfig, progress: Progress) -> Fronts:
    """The fronts that a design's file asks for; double precision, as in `find`.

    **Errors**: ConfigError where the objective was no number at any start.
    """
    asked = config.pareto
    if asked is None:
        raise ValueError("no front is asked for; give the configuration a section 'pareto'")
    with allow("float64"):
        problem = build_problem(config)
        fronts = Fronts(
            _thickness(config, asked, problem, progress) if asked.thickness else None,
            _captures(config, asked, problem, progress) if asked.captures else None,
            _light(config, asked, problem, progress) if asked.light else None,
            float(problem.exact.frequencies.highest),
            _variance(config) if asked.captures else None,
        )
    if fronts.captures is None:
        return fronts
    points = []
    for point in fronts.captures.points:
        progress(f"{point.cost:g} captures, simulated")
        points.append(point._replace(simulated=_simulated(config, point)))
    return fronts._replace(captures=fronts.captures._replace(points=tuple(points)))


def _thickness(
    config: DesignConfig, asked: ParetoConfig, problem: Problem, progress: Progress
) -> Front:
    """Limit of resolution of designs whose distances are all within a thickness."""
    assert asked.thickness is not None  # for the type checker
    given = problem._replace(goal=Goal("limit"))
    distance = jnp.asarray([v.name == "distance" for v in given.space.variables])
    costs, problems = asked.thickness.costs(), []
    for cost in costs:
        upper = given.space.upper
        thin = jnp.where(distance, jnp.minimum(upper, cost), upper)
        space = eqx.tree_at(lambda s: s.upper, given.space, thin)
        problems.append(given._replace(space=space))
    points = _line(config, asked, costs, problems, lambda c: progress(f"thickness {c:.3g} mm"))
    longest = max(shot.distance for shot in config.reference.shots)
    return Front(points, _point(config, longest, _reference(config, given)))


def _light(
    config: DesignConfig, asked: ParetoConfig, problem: Problem, progress: Progress
) -> Front:
    """Limit of resolution of designs with so many electrons."""
    assert asked.light is not None  # for the type checker
    given = problem._replace(goal=Goal("limit"))
    costs = asked.light.costs()
    problems = [_lit(given, cost) for cost in costs]
    points = _line(config, asked, costs, problems, lambda c: progress(f"light {c:.4g} electrons"))
    electrons = config.noise.electrons or 0.0
    return Front(points, _point(config, electrons, _reference(config, given)))


def _line(
    config: DesignConfig,
    asked: ParetoConfig,
    costs: list[float],
    problems: list[Problem],
    told: Callable[[float], None],
) -> tuple[Point, ...]:
    """Each for itself; then near the next, from the last on; then near the one before."""
    best = []
    for cost, problem in zip(costs, problems, strict=True):
        told(cost)
        best.append(_best(config, asked, problem, None))
    for n in range(len(best) - 2, -1, -1):
        told(costs[n])
        best[n] = _best(config, asked, problems[n], best[n + 1], best[n])
    for n in range(1, len(best)):
        told(costs[n])
        best[n] = _best(config, asked, problems[n], best[n - 1], best[n])
    return tuple(_point(config, cost, one) for cost, one in zip(costs, best, strict=True))


def _captures(
    config: DesignConfig, asked: ParetoConfig, problem: Problem, progress: Progress
) -> Front:
    """Error of designs of so many captures, which share the reference's exposure time."""
    assert asked.captures is not None  # for the type checker
    phases = len(config.reference.method().shot_phases())
    points: list[Point] = []
    best: _Judged | None = None
    for count in asked.captures.shots:
        progress(f"{count * phases} captures")
        given = _of_shots(config, problem, count)
        if best is not None:
            best = best._replace(design=_longer(best.design, given.space.base, phases))
        best = _best(config, asked, given, best)
        points.append(_point(config, float(count * phases), best))
    reference = _reference(config, problem)
    return Front(tuple(points), _point(config, float(problem.space.base.captures), reference))


def _of_shots(config: DesignConfig, problem: Problem, count: int) -> Problem:
    """The search for designs of so many shots, on the frequencies of the others.

    With noise that counts electrons they divide the exposure of the reference's captures evenly.
    """
    changed = with_shots(config, count)
    matrix = jnp.asarray(synthesis_matrix(changed.reference.method()), float)
    space = changed.space()
    if config.noise.electrons is not None:
        captures = space.base.captures
        share = jnp.full(captures, problem.space.base.captures / captures, space.lower.dtype)
        space = eqx.tree_at(lambda s: s.base.exposure, space, share)
    return Problem(
        Goal("bayes_error"),
        space,
        problem.data._replace(synthesis=matrix),
        problem.exact._replace(synthesis=matrix),
    )


def _lit(problem: Problem, electrons: float) -> Problem:
    """With so many electrons."""

    def lit(data: Data) -> Data:
        noise = data.setup.noise
        assert isinstance(noise, PhotonNoise)  # for the type checker; the file was checked
        number = jnp.asarray(electrons, noise.electrons.dtype)
        return data._replace(
            setup=eqx.tree_at(lambda s: s.noise.electrons, data.setup, number),
        )

    return problem._replace(data=lit(problem.data), exact=lit(problem.exact))


def _longer(design: Design, base: Design, phases: int) -> Design:
    """A design with its last shot taken again, as often as `base` has captures more."""
    last = range(design.captures - phases, design.captures)
    more = (base.captures - design.captures) // phases
    order = jnp.asarray([*range(design.captures), *(list(last) * more)])
    return eqx.tree_at(
        lambda d: (d.beta, d.distance, d.wavelength, d.width),
        base,
        (design.beta[order], design.distance[order], design.wavelength[order], design.width),
    )


def _best(
    config: DesignConfig,
    asked: ParetoConfig,
    problem: Problem,
    beside: _Judged | None,
    own: _Judged | None = None,
) -> _Judged:
    """The best of a search near another design, of that design, and of `own`.

    Without `own`, the best of a search over the whole space in its place.
    """
    spaces = [problem.space] if own is None else []
    designs: list[Design] = []
    if beside is not None:
        place = jnp.clip(problem.space.point(beside.design), 0.0, 1.0)
        spaces.append(_near(problem.space, place))
        designs.append(problem.space.design(place))
    for space in spaces:
        searched = search_problem(problem._replace(space=space), asked, config.seed)
        designs += [found.design for found in searched.found[:_TRIED]]
    judged = [_judge(config, design, problem.exact) for design in designs]
    judged = _known(judged if own is None else [own, *judged])
    if problem.goal.name == "limit":
        return min(judged, key=lambda j: (-j.resolution, j.error))
    return min(judged, key=lambda j: j.error)


def _known(judged: Iterable[_Judged]) -> list[_Judged]:
    known = [j for j in judged if np.isfinite(j.error)]
    if not known:
        raise ConfigError(
            "pareto: the objective is no number at any start; give bounds nearer to the reference"
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


def _reference(config: DesignConfig, problem: Problem) -> _Judged:
    return _judge(config, problem.space.base, problem.exact)


def _judge(config: DesignConfig, design: Design, data: Data) -> _Judged:
    """Resolution and error by the exact response; no resolution beyond what the pixels sample."""
    found, error = (float(value) for value in _exactly(design, data))
    edge = float(data.frequencies.highest)
    nyquist = float(jnp.max(design.distance)) / (2 * config.sensor.pitch)
    ends = "at the band's end" if found >= edge * (1 - 1e-9) else ""
    if nyquist < min(found, edge):
        ends = "at the pixels' Nyquist frequency"
    return _Judged(design, min(found, edge, nyquist), ends, error)


@eqx.filter_jit
def _exactly(design: Design, data: Data) -> tuple[Float[Array, ""], Float[Array, ""]]:
    known = channels(design, data.setup, data.synthesis, data.frequencies)
    return limit(known, data.frequencies), bayes_error(known)


def _point(config: DesignConfig, cost: float, best: _Judged) -> Point:
    phases = len(config.reference.method().shot_phases())
    shots = shots_of_design(best.design, phases)
    return Point(cost, shots, best.resolution, best.ends, best.error)


def _variance(config: DesignConfig) -> float:
    study = build_study(config)
    images = (np.asarray(build_plane(study, t).image, dtype=float) for t in config.pictures())
    return float(np.exp(np.mean([np.log(np.mean(np.var(i, axis=(-2, -1)))) for i in images])))


class _Named(NamedTuple):
    name: str
    shots: tuple[Shot, ...]


def _simulated(config: DesignConfig, point: Point) -> tuple[tuple[str, float | None], ...]:
    """PSNR of every picture in the full simulation, at the seed of the configuration."""
    # What the reference cannot be called.
    name = found_name(1)
    study = build_study(config, [_Named(name, point.shots)])
    study = study.model_copy(update={"methods": study.methods[-1:]})
    pictures = {t.name for t in config.pictures()}
    return tuple(
        (target.name, simulate(study, index, target, 1)[name][0]["psnr_db"])
        for index, target in enumerate(study.targets)
        if target.name in pictures
    )
