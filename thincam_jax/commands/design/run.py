"""Running a design: the search, the simulation of what it found, and a report."""

from dataclasses import astuple
from functools import cached_property
from typing import Any

from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import slug
from thincam_jax.commands.design import figures, simulation
from thincam_jax.commands.design.config import DesignConfig
from thincam_jax.commands.design.page import shown as shown_on_page
from thincam_jax.commands.design.pareto import FrontSearches
from thincam_jax.commands.design.ranking import Finder
from thincam_jax.commands.design.record import record, record_fronts
from thincam_jax.commands.run_folder import Progress, Run, RunFolder
from thincam_jax.commands.study.build import FileStudy
from thincam_jax.plot.studies import draw_found
from thincam_jax.studies.evaluate import Evaluation
from thincam_jax.studies.study import Target


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
        self.complete("design", command="design", **shown_on_page(self.metrics))
