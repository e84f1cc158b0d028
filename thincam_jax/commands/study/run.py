"""Running a study: every target through every method, into a run folder."""

import time
from functools import partial
from typing import Any

from thincam_jax.commands.run_folder import Progress, RunFolder, Step, carry_out
from thincam_jax.commands.study import figures
from thincam_jax.commands.study.build import take
from thincam_jax.commands.study.evaluate import Evaluation, evaluate_method, mean_psnr_of_pictures
from thincam_jax.commands.study.page import render
from thincam_jax.commands.study.response import Response, method_response
from thincam_jax.commands.study.study import Capture, Exposure, Method, Study, Target


def run_study(study: Study, folder: RunFolder, progress: Progress) -> dict[str, Any]:
    """Run what the folder does not hold yet; returns (and writes) the metrics.

    The same configuration gives the same metrics: every capture's noise has its own key, from the
    seed and the capture's place in the study.
    """
    folder.claim(study.config)
    run = _StudyRun(study, folder)
    carry_out(run.work, progress)
    return run.metrics


class _StudyRun:
    """A study on its way; `results` are by target, `evaluations` those of the target at hand.

    `work` holds every capture and method of each target that the folder has no results of, the
    transfer functions and the report.
    """

    def __init__(self, study: Study, folder: RunFolder):
        self.study, self.folder, self.started = study, folder, time.time()
        self.captures: dict[Exposure, Capture] = {}
        self.evaluations: dict[str, Evaluation] = {}
        self.results: dict[str, dict[str, Any]] = {}
        self.responses: dict[str, Response] = {}
        self.metrics: dict[str, Any] = {}
        self.work: list[Step] = []
        for target in study.targets:
            stored = folder.finished(target.name)
            if stored is None:
                self.work += self._work_on(target)
            else:
                self.results[target.name] = stored
        for method in study.methods:
            text = f"transfer function of {method.name}"
            self.work.append(Step(text, partial(self.transfer, method)))
        self.work.append(Step("report", self.report))

    def _work_on(self, target: Target) -> list[Step]:
        captures = [
            Step(f"{target.name}: capture {number}", partial(self.capture, target, exposure))
            for number, exposure in enumerate(self.study.exposures, 1)
        ]
        return captures + [
            Step(f"{target.name}: {method.name}", partial(self.reconstruct, target, method))
            for method in self.study.methods
        ]

    def capture(self, target: Target, exposure: Exposure) -> None:
        self.captures[exposure] = take(self.study, exposure, target)

    def reconstruct(self, target: Target, method: Method) -> None:
        found = evaluate_method(self.study, method, target, self.captures)
        self.evaluations[method.name] = found
        if method is self.study.methods[-1]:
            self.finish(target)

    def finish(self, target: Target) -> None:
        first = self.captures[self.study.exposures[0]].image
        figures.save_target(self.folder, self.study, target, first, self.evaluations)
        figures.save_captures(self.folder, self.study, target, self.captures)
        found = self.evaluations.items()
        contrasts = {name: e.contrast for name, e in found if e.contrast is not None}
        metrics = {name: e.metrics for name, e in found}
        self.results[target.name] = {"metrics": metrics, "contrasts": contrasts}
        self.folder.finish(target.name, self.results[target.name])
        self.captures, self.evaluations = {}, {}

    def transfer(self, method: Method) -> None:
        self.responses[method.name] = method_response(self.study, method)

    def report(self) -> None:
        study, folder = self.study, self.folder
        self.metrics = self.collected()
        figures.save_responses(folder, study, self.responses)
        # Of several charts the last.
        contrasts: dict[str, list] = {}
        for target in study.targets:
            contrasts |= self.results[target.name]["contrasts"]
        if contrasts:
            figures.save_contrasts(folder, contrasts)
        figures.save_psf(folder, study)
        page = partial(render, study.config, folder, self.metrics)
        folder.complete(self.metrics, study.config.seed, self.started, page)

    def collected(self) -> dict[str, Any]:
        """What goes into metrics.json."""
        study, methods = self.study, {}
        for method, entry in zip(study.methods, study.config.methods, strict=True):
            targets = {t.name: self.results[t.name]["metrics"][method.name] for t in study.targets}
            methods[method.name] = {
                "captures": len(method.exposures),
                "mean_psnr_of_pictures_db": mean_psnr_of_pictures(study, targets),
                "limits": self.responses[method.name].metrics,
                "targets": targets,
                "published": {
                    "psnr_db": entry.published.psnr_db,
                    "resolved_object_mm": entry.published.resolved,
                    "limit_cycles_per_mm": entry.published.limit_cycles_per_mm,
                },
            }
        return {
            "study": study.config.name,
            "seed": study.config.seed,
            "methods": methods,
            "warnings": study.warnings,
        }
