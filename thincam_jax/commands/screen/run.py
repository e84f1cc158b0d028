"""Running a screen experiment: the study and its calibration, into a run folder."""

import resource
import sys
from dataclasses import asdict
from typing import Any

import numpy as np

from thincam_jax.commands.config_file import slug
from thincam_jax.commands.run_folder import Progress, Run, RunFolder
from thincam_jax.commands.screen import figures, report
from thincam_jax.commands.screen.build import FileScreen
from thincam_jax.commands.study.figures import save_figure, save_image
from thincam_jax.studies.screen import ModelResult, ScreenResult, ScreenRun, summarise_rays
from thincam_jax.studies.screen_calibration import MEASURED, CalibrationRun


def run_screen(study: FileScreen, folder: RunFolder, progress: Progress) -> ScreenResult:
    """Run a study into a folder; its result has the model that a calibration measured, too."""
    run = _ScreenRun(study, folder)
    run.carry_out(progress)
    return run.result


class _ScreenRun(Run):
    """A study, its calibration where the file has one, and their report."""

    result: ScreenResult

    def __init__(self, study: FileScreen, folder: RunFolder):
        super().__init__(study.config, folder)
        self.study, self.models, self.calibration = study, ScreenRun(study), None
        self.work += self.models.work
        if self.config.calibration is not None:
            calibration = self.config.calibration.build()
            self.calibration = CalibrationRun(study, calibration, folder.path)
            self.work += self.calibration.work
        self.add("report", self.report)

    def report(self) -> None:
        study, found = self.study, dict(self.models.result.models)
        rays, peak = study.rays(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        calibrated = None
        if self.calibration is not None:
            calibrated = self.calibration.result
            found[MEASURED] = ModelResult("by Hadamard patterns, with noise", calibrated.methods)
        result = self.result = ScreenResult(study, found)
        summary = summarise_rays(study, rays)
        ranges = {name: value for name, value in asdict(summary).items() if value is not None}
        memory = round(peak * (1 if sys.platform == "darwin" else 1024) / 1e9, 2)
        self.metrics = {
            "study": study.name,
            "kind": self.config.kind,
            "seed": study.seed,
            "rays": ranges,
            "models": {name: _scores(model) for name, model in found.items()},
            "entries_of_the_system": int(study.systems[0].values.size),
            "peak_memory_gb": memory,
        }
        drawn = {
            "rays": figures.draw_rays(study),
            "field": figures.draw_field(study, rays),
            "images": figures.draw_images(result),
            "models": figures.draw_models(result),
            "errors": figures.draw_errors(result),
        }
        if calibrated is not None:
            self.metrics["calibration"] = asdict(calibrated.scores)
            pitch = float(study.camera.sensor.pitch)
            drawn["columns"] = figures.draw_columns(pitch, calibrated.cells, calibrated.columns)
            if calibrated.images:
                drawn["distances"] = figures.draw_distances(calibrated)
        for name, figure in drawn.items():
            save_figure(self.folder, name, figure)
        for name, one in found[study.models[0].name].methods.items():
            for target, image in zip(study.targets, one.images, strict=True):
                save_image(self.folder, f"{slug(target)}--{slug(name)}", np.asarray(image))
        scores = None if calibrated is None else calibrated.scores
        self.complete(report.page(self.config, result, summary, scores, memory))


def _scores(model: ModelResult) -> dict[str, Any]:
    methods = {name: asdict(one.scores) for name, one in model.methods.items()}
    return {"mistake": model.mistake, "methods": methods}
