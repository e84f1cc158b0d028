"""Running a design: the search, the simulation of the designs found, and a report."""

from collections.abc import Iterable
from dataclasses import asdict, astuple, dataclass
from functools import cached_property, partial
from typing import Any

from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import ConfigError, slug
from thincam_jax.commands.design import report
from thincam_jax.commands.design.build import as_study_config
from thincam_jax.commands.design.config import DesignConfig
from thincam_jax.commands.run_folder import Progress, Run, RunFolder, Step, as_record
from thincam_jax.design.search import NonFiniteObjectiveError
from thincam_jax.plot import design as plot
from thincam_jax.plot.frame import as_png
from thincam_jax.plot.studies import draw_found
from thincam_jax.studies.design import DesignSearch, DesignStudy, FrontSearches
from thincam_jax.studies.design_result import DesignResult
from thincam_jax.studies.design_scores import DesignScores
from thincam_jax.studies.evaluate import Evaluation, Scores
from thincam_jax.studies.study import Study, Target
from thincam_jax.studies.trials import Trials, simulate_trials


class DesignFolder(RunFolder):
    """Files of one design, each written whole or not at all.

    - `config.yaml`: the resolved configuration.
    - `found.yaml`: the reference and the best designs, for `thincam run`.
    - `targets/NAME.json`: the simulation of a finished target; an interrupted design skips these.
    - `reconstructions-NAME.png`: reconstructions of a target's scene, written with its simulation.
    - `masks.png`, `landscape.png`, `training.png`, `responses.png`, `mtf.png`, `pareto.png`,
      `environment.json`, `report.html`, `design.json`: written at the end.
    """

    kind, folders, pictures, result = "design", ("targets",), "", "design.json"


def run_design(design: DesignStudy, folder: DesignFolder, progress: Progress) -> DesignScores:
    """Search, simulate and report; returns (and writes) what goes into design.json.

    The same configuration gives the same on the same machine.
    """
    return _DesignRun(design, folder).carry_out(progress).scores


@dataclass(frozen=True)
class FinishedTarget:
    """Simulation of a target: the exposures of each design, and the scores of each seed."""

    designs: list[list[list[Any]]]
    trials: dict[str, list[Scores]]


class _DesignRun(Run):
    """A design on its way: search, simulation of each target, fronts."""

    config: DesignConfig
    scores: DesignScores

    def __init__(self, design: DesignStudy, folder: DesignFolder):
        super().__init__(design.study.config, folder)
        self.design, self.search, self.fronts = design, DesignSearch(design), None
        self.trials: dict[str, Trials] = {}
        self.work += _blaming("search", self.search.searching)
        self.work += _blaming("train", self.search.training)
        self.work += self.search.ranking
        for target in design.study.targets:
            self.add(target.name, self.simulate, target)
        if design.fronts is not None:
            self.fronts = FrontSearches(design, design.fronts)
            self.work += _blaming("pareto", self.fronts.work)
        self.add("report", self.report)

    @cached_property
    def simulated(self) -> Study:
        """The designs of the file and the best of those found."""
        return self.design.simulated(self.search.result)

    def simulate(self, target: Target) -> None:
        """Simulate a target, or read its trials from before an interruption of these designs."""
        methods = self.simulated.methods
        self.folder.write("found.yaml", dump_config(as_study_config(self.config, methods)))
        designs = [[list(astuple(e)) for e in method.exposures] for method in methods]
        held = self.folder.finished(target.name)
        stored = None if held is None else as_record(FinishedTarget, held)
        if stored is None or stored.designs != designs:
            shown: dict[str, Evaluation] = {}
            trials = simulate_trials(self.simulated, target, self.design.seeds, shown)
            figure, *_ = draw_found(target, shown)
            self.folder.write(f"reconstructions-{slug(target.name)}.png", as_png(figure))
            stored = FinishedTarget(designs, trials)
            self.folder.finish(target.name, asdict(stored))
        self.trials[target.name] = stored.trials

    def report(self) -> None:
        found, design, folder = self.search.result, self.design, self.folder
        fronts = None if self.fronts is None else self.fronts.result()
        self.scores = DesignResult(design, found, self.trials, fronts).scores
        self.metrics = asdict(self.scores)
        count, distance = design.best, design.study.object_distance
        pictures = {
            "masks.png": plot.draw_masks(self.simulated, found.found[0].name),
            "landscape.png": plot.draw_objective(found, count),
            "training.png": plot.draw_training(found, count),
            "responses.png": plot.draw_responses(found, count, self.config.sensor.pitch),
            "mtf.png": plot.draw_mtf(found, distance),
        }
        if (pareto := self.scores.pareto) is not None:
            pictures["pareto.png"] = plot.draw_fronts(pareto, found.reference.name, distance)
        for name, figure in pictures.items():
            if figure is not None:
                folder.write(name, as_png(figure))
        self.complete(report.page(self.config, self.scores))


def _blaming(section: str, steps: Iterable[Step]) -> list[Step]:
    """Steps that report an objective that is NaN at every start as a fault of a section."""

    def do(step: Step) -> None:
        try:
            step.do()
        except NonFiniteObjectiveError as error:
            raise ConfigError(f"{section}: {error}") from None

    return [Step(step.text, partial(do, step)) for step in steps]
