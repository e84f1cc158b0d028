"""Running a design: the search, the simulation of the designs found, and a report."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import astuple, replace
from functools import cached_property, partial
from typing import Any

import jax
import numpy as np

from thincam_jax._core.precision import allow
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import ConfigError, slug
from thincam_jax.commands.design import build, figures, report, simulation
from thincam_jax.commands.design.config import DesignConfig
from thincam_jax.commands.design.config_pareto import ParetoConfig
from thincam_jax.commands.design.record import (
    FoundDesigns,
    Front,
    Fronts,
    record,
    record_fronts,
)
from thincam_jax.commands.run_folder import Progress, Run, RunFolder, Step
from thincam_jax.commands.study.build import FileStudy
from thincam_jax.design import (
    DesignProblem,
    Found,
    FrontSearch,
    NonFiniteObjectiveError,
    RankedDesign,
    Search,
    TrainedDesigns,
    TrainingDescents,
    TrainingSettings,
    distinct_designs,
    find_designs,
    found_name,
    front_point,
    modulation_transfer,
    rank_designs,
    rank_trained,
    score_design,
)
from thincam_jax.design.fronts import search_order
from thincam_jax.design.landscape import landscape_if_any
from thincam_jax.plot.studies import draw_found
from thincam_jax.studies.evaluate import Evaluation
from thincam_jax.studies.study import Target

_FRONT_STEPS = {
    "thickness": "thickness {:.3g} mm",
    "captures": "{:g} captures",
    "light": "light {:.4g} electrons",
}


class DesignFolder(RunFolder):
    """Files of one design, each written whole or not at all.

    - `config.yaml`: the resolved configuration.
    - `found.yaml`: the reference and the best designs, for `thincam run`.
    - `targets/NAME.json`: the simulation of a finished target; an interrupted design skips these.
    - `reconstructions-NAME.png`: of the scene of a target, written with its simulation.
    - `masks.png`, `landscape.png`, `training.png`, `responses.png`, `mtf.png`, `pareto.png`,
      `environment.json`, `report.html`, `design.json`: written at the end.
    """

    kind, folders, pictures, result = "design", ("targets",), "", "design.json"


def run_design(study: FileStudy, folder: DesignFolder, progress: Progress) -> dict[str, Any]:
    """Search, simulate and report; returns (and writes) what goes into design.json.

    `study` holds the designs of the file. The same configuration gives the same on the same
    machine.
    """
    return _DesignRun(study, folder).carry_out(progress)


class _DesignRun(Run):
    """A design on its way: search, simulation of each target, fronts."""

    config: DesignConfig

    def __init__(self, study: FileStudy, folder: DesignFolder):
        super().__init__(study.config, folder)
        self.study = study
        self.trials: dict[str, simulation.Trials] = {}
        self.finder = Finder(study)
        self.fronts = None
        self.work += self.finder.work
        for target in study.targets:
            self.add(target.name, self.simulate, target)
        if self.config.pareto is not None:
            self.fronts = FrontSearches(study, self.config.pareto)
            self.work += self.fronts.work
        self.add("report", self.report)

    @cached_property
    def simulated(self) -> FileStudy:
        """The designs of the file and the best of those found."""
        best = self.finder.result.found[: self.config.validation.best]
        return simulation.with_designs(self.study, {one.name: one.design for one in best})

    def simulate(self, target: Target) -> None:
        """From before an interruption where the designs are still the same."""
        self.folder.write("found.yaml", dump_config(simulation.as_study_config(self.simulated)))
        designs = [
            [list(astuple(e)) for e in method.exposures] for method in self.simulated.methods
        ]
        stored = self.folder.finished(target.name)
        if stored is None or stored["designs"] != designs:
            shown: dict[str, Evaluation] = {}
            trials = simulation.simulate(
                self.simulated, target, self.config.validation.seeds, shown
            )
            figure, *_ = draw_found(target, shown)
            name = f"reconstructions-{slug(target.name)}.png"
            self.folder.write(name, figures.as_png(figure))
            stored = {"designs": designs, "trials": trials}
            self.folder.finish(target.name, stored)
        self.trials[target.name] = stored["trials"]

    def report(self) -> None:
        result, folder = self.finder.result, self.folder
        self.metrics = record(result, self.simulated, simulation.compare(self.trials))
        self.metrics["warnings"] = self.simulated.warnings
        if self.fronts is not None:
            self.metrics["pareto"] = record_fronts(self.config, self.fronts.result())
        count, distance = self.config.validation.best, self.config.object.distance
        pictures = {
            "masks.png": figures.draw_masks(self.simulated, result.found[0].name),
            "landscape.png": figures.draw_landscape(result, count),
            "training.png": figures.draw_training(result, count),
            "responses.png": figures.draw_responses(result, count, self.config.sensor.pitch),
            "mtf.png": figures.draw_mtf(result, distance),
        }
        if self.fronts is not None:
            name = result.reference.name
            pictures["pareto.png"] = figures.draw_fronts(self.metrics["pareto"], name, distance)
        for name, figure in pictures.items():
            if figure is not None:
                folder.write(name, figures.as_png(figure))
        self.complete(report.page(self.config, self.metrics))


class Finder:
    """The search of a design's file: its list of work, which ends with the `result`.

    In double precision: the objective's fringes are finer than single holds. Training, which is not
    that fine, is in the precision that JAX is set to.

    **Errors**: ConfigError where the objective was NaN at every start.
    """

    problem: DesignProblem
    searched: Search
    kept: tuple[Found, ...]
    descents: TrainingDescents
    trained: TrainedDesigns | None = None
    found: tuple[RankedDesign, ...]
    result: FoundDesigns

    def __init__(self, study: FileStudy):
        self.study = study
        self.config: DesignConfig = study.config
        self.key = jax.random.key(self.config.seed)
        self.work = [Step("search", self.search)]
        if (wanted := self.config.train) is not None:
            self.work.append(Step("training, samples", self.sample))
            for number in range(wanted.starts):
                text = f"training {number + 1} of {wanted.starts}"
                self.work.append(Step(text, lambda n=number: self.descents.descend(n)))
            self.work.append(Step("around the trained designs", self.finish_training))
        self.work += [Step("found designs", self.rank), Step("landscape", self.surround)]

    def search(self) -> None:
        with allow("float64"), _blaming("search"):
            self.problem = build.build_problem(self.study)
            settings = build.search_settings(self.config.search)
            self.searched = find_designs(self.problem, settings, key=self.key)
            self.kept = distinct_designs(self.problem.space, self.searched.found)

    def sample(self) -> None:
        asked = self.config.train
        assert asked is not None  # for the type checker
        points = [np.asarray(one.point) for one in self.kept]
        grid = self.config.search.grid
        settings = TrainingSettings(asked.samples, asked.starts, asked.steps, grid)
        problem = build.training_problem(self.config, self.problem)
        self.descents = TrainingDescents(problem, points, settings, self.key)

    def finish_training(self) -> None:
        with _blaming("train"):
            self.trained = self.descents.finish()

    def rank(self) -> None:
        with allow("float64"):
            if self.trained is None:
                self.found = rank_designs(self.problem, self.kept)
            else:
                self.found = rank_trained(self.problem, self.trained)

    def surround(self) -> None:
        problem, base, best = self.problem, self.problem.space.base, self.found[0].design
        with allow("float64"):
            reference = score_design(problem, base, self.config.reference.name)
            if self.trained is not None:
                reference = replace(reference, trained=self.trained.reference)
            self.result = FoundDesigns(
                build.build_objective(self.config.search),
                reference,
                self.found,
                self.searched.evaluations,
                self.searched.failed,
                float(problem.data.setup.prior.exponent),
                float(problem.data.frequencies.highest),
                landscape_if_any(problem, best, self.config.search.grid),
                tuple(modulation_transfer(one, problem.exact) for one in (base, best)),
                self.trained,
            )


class FrontSearches:
    """The fronts that a design's file asks for: their list of work, and what it results in.

    Captures share the reference's exposure time, and are simulated in full. Double precision, as in
    `Finder`.

    **Errors**: ConfigError where the objective was NaN at every start.
    """

    def __init__(self, study: FileStudy, asked: ParetoConfig):
        self.study, self.asked = study, asked
        self.config: DesignConfig = study.config
        self.costs = asked.costs(len(self.config.reference.phases))
        self.simulated: list[tuple[tuple[str, float | None], ...]] = []
        self.work: list[Step] = []
        for name, costs in self.costs.items():
            rising = name == "captures"
            for place, beside in search_order(len(costs), rising_captures=rising):
                search = partial(self.search, name, place, beside)
                self.work.append(Step(_FRONT_STEPS[name].format(costs[place]), search))
        for place, cost in enumerate(self.costs.get("captures", ())):
            self.work.append(Step(f"{cost:g} captures, simulated", partial(self.simulate, place)))

    @cached_property
    def problem(self) -> DesignProblem:
        """On the frequencies of the reference, which all points share."""
        return build.build_problem(self.study)

    @cached_property
    def searches(self) -> dict[str, FrontSearch]:
        """Of each front."""
        settings, key = build.search_settings(self.asked), jax.random.key(self.config.seed)
        problems = {
            name: build.front_problems(self.config, self.problem, name, costs)
            for name, costs in self.costs.items()
        }
        return {name: FrontSearch(each, settings, key) for name, each in problems.items()}

    def search(self, name: str, place: int, beside: int | None) -> None:
        """A point of a front, near that of another place or over the whole space."""
        with allow("float64"), _blaming("pareto"):
            self.searches[name].advance(place, beside)

    def simulate(self, place: int) -> None:
        """PSNR of every picture in the full simulation, at the seed of the configuration."""
        design, name = self.searches["captures"].points[place].design, found_name(1)
        study = simulation.with_designs(replace(self.study, methods=()), {name: design})
        self.simulated.append(
            tuple(
                (target.name, simulation.simulate(study, target, 1)[name][0]["psnr_db"])
                for target in study.targets
                if target.is_picture
            )
        )

    def result(self) -> Fronts:
        """When all work is done."""
        costs = {
            "thickness": max(shot.distance for shot in self.config.reference.shots),
            "captures": float(self.problem.space.base.captures),
            "light": self.config.noise.electrons or 0.0,
        }
        with allow("float64"):
            reference = front_point(self.problem.space.base, self.problem.exact)
        fronts = {
            name: Front(search.points, replace(reference, cost=costs[name]))
            for name, search in self.searches.items()
        }
        variance = _variance(self.study) if "captures" in fronts else None
        edge = float(self.problem.exact.frequencies.highest)
        return Fronts(fronts, edge, variance, tuple(self.simulated))


def _variance(study: FileStudy) -> float:
    """Geometric mean over the pictures."""
    planes = (target.plane for target in study.targets if target.is_picture)
    images = (np.asarray(plane.image, dtype=float) for plane in planes)
    return float(np.exp(np.mean([np.log(np.mean(np.var(i, axis=(-2, -1)))) for i in images])))


@contextmanager
def _blaming(section: str) -> Iterator[None]:
    """Report an objective that is NaN at every start as a fault of a section of the file."""
    try:
        yield
    except NonFiniteObjectiveError as error:
        raise ConfigError(f"{section}: {error}") from None
