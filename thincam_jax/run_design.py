"""Running a design: the search, the simulation of what it found, and a report."""

import time
from typing import Any

from thincam_jax.config import Section, StudyConfig, dump_config
from thincam_jax.config_design import DesignConfig
from thincam_jax.design_run import FIND_STEPS, build_study, compare, find, full_well, simulate
from thincam_jax.design_run.record import record
from thincam_jax.doctor import environment
from thincam_jax.report import design_figures as figures
from thincam_jax.report.design_page import render
from thincam_jax.study import RunFolder
from thincam_jax.study.folder import claim_folder, to_json
from thincam_jax.study.target import Progress


class DesignFolder(RunFolder):
    """Files of one design, each written whole or not at all.

    - `config.yaml`: the resolved configuration.
    - `found.yaml`: the reference and the best designs, for `thincam run`.
    - `targets/NAME.json`: the simulation of a finished target; an interrupted design skips these.
    - `landscape.png`, `responses.png`, `environment.json`, `report.html`, `design.json`: written at
      the end.
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
    return FIND_STEPS + len(config.targets) + 1


def run_design(config: DesignConfig, folder: DesignFolder, progress: Progress) -> dict[str, Any]:
    """Search, simulate and report; returns (and writes) what goes into design.json.

    The same configuration gives the same on the same machine.
    """
    started = time.time()
    folder.claim(config)
    result = find(config, progress)
    best = result.found[: config.validation.best]
    study = build_study(config, best, full_well(config))
    folder.write("found.yaml", dump_config(study))
    trials = {}
    for index, target in enumerate(study.targets):
        progress(target.name)
        trials[target.name] = _target(config, study, index, folder)
    design = record(config, result, study, compare(study, trials))
    progress("report")
    landscape = figures.draw_landscape(result, len(best))
    if landscape is not None:
        folder.write("landscape.png", figures.as_png(landscape))
    responses = figures.draw_responses(result, len(best), study.sensor.pitch)
    folder.write("responses.png", figures.as_png(responses))
    surroundings = environment(time.time() - started)
    folder.write("environment.json", to_json({**surroundings, "seed": config.seed}))
    folder.write("report.html", render(config, folder.path, design, surroundings))
    # Last: it marks the design as complete.
    folder.write("design.json", to_json(design))
    return design


def _target(config: DesignConfig, study: StudyConfig, index: int, folder: DesignFolder):
    """The trials of a target, from before the interruption where the designs are still the same."""
    target = study.targets[index]
    designs = [[[s.beta, s.distance] for s in m.shots] for m in study.methods]
    stored = folder.finished(target.name)
    if stored is None or stored["designs"] != designs:
        trials = simulate(study, index, target, config.validation.seeds)
        stored = {"designs": designs, "trials": trials}
        folder.finish(target.name, stored)
    return stored["trials"]
