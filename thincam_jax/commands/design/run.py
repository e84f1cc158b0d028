"""Running a design: the search, the simulation of what it found, and a report."""

import time
from typing import Any

from thincam_jax.commands.design import figures as figures
from thincam_jax.commands.design.compare import compare
from thincam_jax.commands.design.config import DesignConfig
from thincam_jax.commands.design.page import render
from thincam_jax.commands.design.pareto import find_fronts, pareto_steps
from thincam_jax.commands.design.pareto_figure import draw_fronts
from thincam_jax.commands.design.ranking import Result, find, find_steps
from thincam_jax.commands.design.record import record, record_fronts
from thincam_jax.commands.design.simulate import simulate
from thincam_jax.commands.design.simulated import build_study
from thincam_jax.commands.doctor import environment
from thincam_jax.commands.run_folder import RunFolder, claim_folder, to_json
from thincam_jax.commands.study.config import Section, StudyConfig, dump_config
from thincam_jax.commands.study.target import Progress


class DesignFolder(RunFolder):
    """Files of one design, each written whole or not at all.

    - `config.yaml`: the resolved configuration.
    - `found.yaml`: the reference and the best designs, for `thincam run`.
    - `targets/NAME.json`: the simulation of a finished target; an interrupted design skips these.
    - `landscape.png`, `training.png`, `responses.png`, `mtf.png`, `pareto.png`, `environment.json`,
      `report.html`, `design.json`: written at the end.
    """

    def claim(self, config: Section) -> None:
        """As for a study; what marks a complete design is design.json."""
        claim_folder(self.path, "config.yaml", dump_config(config), "design", ("targets",))
        if (self.path / "design.json").exists():
            for result in (self.path / "targets").glob("*.json"):
                result.unlink()
            (self.path / "design.json").unlink()


def steps(config: DesignConfig) -> int:
    """How many times `run_design` reports progress."""
    return find_steps(config) + len(config.targets) + pareto_steps(config.pareto) + 1


def run_design(config: DesignConfig, folder: DesignFolder, progress: Progress) -> dict[str, Any]:
    """Search, simulate and report; returns (and writes) what goes into design.json.

    The same configuration gives the same on the same machine.
    """
    started = time.time()
    folder.claim(config)
    result = find(config, progress)
    best = result.found[: config.validation.best]
    study = build_study(config, best)
    folder.write("found.yaml", dump_config(study))
    trials = {}
    for index, target in enumerate(study.targets):
        progress(target.name)
        trials[target.name] = _target(config, study, index, folder)
    design = record(config, result, study, compare(study, trials))
    if config.pareto is not None:
        design["pareto"] = record_fronts(config, find_fronts(config, progress))
    progress("report")
    _draw(config, result, design, folder)
    surroundings = environment(time.time() - started)
    folder.write("environment.json", to_json({**surroundings, "seed": config.seed}))
    folder.write("report.html", render(config, folder.path, design, surroundings))
    # Last: it marks the design as complete.
    folder.write("design.json", to_json(design))
    return design


def _draw(
    config: DesignConfig, result: Result, design: dict[str, Any], folder: DesignFolder
) -> None:
    count = len(result.found[: config.validation.best])
    distance = config.object.distance
    pictures = {
        "landscape.png": figures.draw_landscape(result, count),
        "training.png": figures.draw_training(result, count),
        "responses.png": figures.draw_responses(result, count, config.sensor.pitch),
        "mtf.png": figures.draw_mtf(result, distance),
    }
    if "pareto" in design:
        name = result.reference.name
        pictures["pareto.png"] = draw_fronts(design["pareto"], name, distance)
    for name, figure in pictures.items():
        if figure is not None:
            folder.write(name, figures.as_png(figure))


def _target(config: DesignConfig, study: StudyConfig, index: int, folder: DesignFolder):
    """The trials of a target, from before the interruption where the designs are still the same."""
    target = study.targets[index]
    designs = [[list(s.model_dump().values()) for s in m.shots] for m in study.methods]
    stored = folder.finished(target.name)
    if stored is None or stored["designs"] != designs:
        trials = simulate(study, index, target, config.validation.seeds)
        stored = {"designs": designs, "trials": trials}
        folder.finish(target.name, stored)
    return stored["trials"]
