"""Running a study: every target through every method, into a run folder."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from thincam_jax.commands.run_folder import Progress, Run, RunFolder
from thincam_jax.commands.study import figures, report
from thincam_jax.commands.study.build import FileStudy
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.plot import studies as plot
from thincam_jax.studies.evaluate import (
    Contrasts,
    Evaluation,
    Resolved,
    Scores,
    evaluate_method,
)
from thincam_jax.studies.response import Response, method_response
from thincam_jax.studies.result import StudyScores, summarise
from thincam_jax.studies.simulate import Capture, take
from thincam_jax.studies.study import Method, Study, Target


def run_study(study: FileStudy, folder: RunFolder, progress: Progress) -> StudyScores:
    """Run what the folder does not hold yet; returns (and writes) the scores.

    The same configuration gives the same scores: every capture's noise has its own key, from the
    seed and the capture's place in the study.
    """
    run = _StudyRun(study, folder)
    run.carry_out(progress)
    return run.scores


class _StudyRun(Run):
    """A study on its way; `evaluations` are those of the target at hand, by method."""

    scores: StudyScores

    def __init__(self, study: FileStudy, folder: RunFolder):
        super().__init__(study.config, folder)
        self.study = study
        self.captures: dict[Exposure, Capture] = {}
        self.evaluations: dict[str, Evaluation] = {}
        self.found: dict[str, dict[str, Scores]] = {}  # by target and method
        self.contrasts: dict[str, dict[str, Contrasts]] = {}
        self.responses: dict[str, Response] = {}
        for target in study.targets:
            stored = folder.finished(target.name)
            if stored is not None:
                self.found[target.name] = {
                    name: _scores(metrics) for name, metrics in stored["metrics"].items()
                }
                self.contrasts[target.name] = {
                    name: [(period, direction, contrast) for period, direction, contrast in rows]
                    for name, rows in stored["contrasts"].items()
                }
                continue
            for count, exposure in enumerate(study.exposures, 1):
                self.add(f"{target.name}: capture {count}", self.capture, target, exposure)
            for method in study.methods:
                self.add(f"{target.name}: {method.name}", self.reconstruct, target, method)
        for method in study.methods:
            self.add(f"transfer function of {method.name}", self.transfer, method)
        self.add("report", self.report)

    def capture(self, target: Target, exposure: Exposure) -> None:
        self.captures[exposure] = take(self.study, exposure, target)

    def reconstruct(self, target: Target, method: Method) -> None:
        found = evaluate_method(self.study, method, target, self.captures)
        self.evaluations[method.name] = found
        if method is self.study.methods[-1]:
            self.finish(target)

    def finish(self, target: Target) -> None:
        study, folder, found = self.study, self.folder, self.evaluations
        first = self.captures[study.exposures[0]].image
        figures.save_images(folder, target, found)
        # No target's name can be taken for one of the study's own figures.
        for kind, figure in (
            ("target", plot.draw_target(study, target, first, found)),
            ("captures", plot.draw_captures(study, self.captures)),
        ):
            figures.save_figure(folder, f"{kind}-{figures.slug(target.name)}", figure)
        contrasts = {name: e.contrast for name, e in found.items() if e.contrast is not None}
        scores = {name: e.scores for name, e in found.items()}
        self.found[target.name], self.contrasts[target.name] = scores, contrasts
        metrics = {name: asdict(one) for name, one in scores.items()}
        folder.finish(target.name, {"metrics": metrics, "contrasts": contrasts})
        self.captures, self.evaluations = {}, {}

    def transfer(self, method: Method) -> None:
        self.responses[method.name] = method_response(self.study, method)

    def report(self) -> None:
        study, folder = self.study, self.folder
        self.scores = summarise(study, study.targets, self.found, self.responses)
        self.metrics = asdict(self.scores)
        figures.save_figure(folder, "mtf", plot.draw_responses(study, self.responses))
        # Of several charts the last.
        contrasts: dict[str, Contrasts] = {}
        for target in study.targets:
            contrasts |= self.contrasts[target.name]
        if contrasts:
            figures.save_figure(folder, "contrast", plot.draw_contrasts(contrasts))
        figures.save_psf(folder, study)
        told = findings(study, self.scores)
        self.complete(report.page(study.config, self.scores, told))


def _scores(metrics: Mapping[str, Any]) -> Scores:
    """The scores that a folder holds."""
    resolved = metrics["resolved"]
    return Scores(**{**metrics, "resolved": resolved and Resolved(**resolved)})


def findings(study: Study, scores: StudyScores) -> list[str]:
    """What the numbers say, in sentences, beside what was published."""
    sentences = []
    for name, method in scores.methods.items():
        mean, stated = method.mean_psnr_of_pictures_db, method.published.psnr_db
        if mean is not None and stated is not None:
            sentences.append(
                f"{name}: {mean:.1f} dB on average over the pictures, published {stated:.1f} dB "
                f"({mean - stated:+.1f} dB)."
            )
        own, stated = method.resolved_mm, method.published.resolved_object_mm
        if own is not None and stated is not None:
            word = "finer" if own < 0.97 * stated else "coarser"
            word = "the same within 3 %" if abs(own / stated - 1) <= 0.03 else word
            sentences.append(
                f"{name}: resolves a line pair of {own:.2f} mm on the object, published "
                f"{stated:.2f} mm: {word}."
            )
    sentences += _gains(study, scores)
    ranked = sorted(
        (one.resolved_mm, name)
        for name, one in scores.methods.items()
        if one.resolved_mm is not None
    )
    if len(ranked) > 1:
        order = ", ".join(f"{name} ({period:.2f} mm)" for period, name in ranked)
        sentences.append(f"From finest to coarsest on the chart: {order}.")
    return sentences


def _sums(method: Method) -> tuple:
    """What two methods share that add and subtract the same captures in the same way."""
    return tuple(method.exposures), method.synthesis, method.phases, method.harmonics


def _gains(study: Study, scores: StudyScores) -> list[str]:
    """What total variation adds to the Wiener synthesis of the same captures."""
    sentences = []
    for method in (m for m in study.methods if m.solver.name == "admm_tv"):
        for other in (m for m in study.methods if m.solver.name == "wiener"):
            if _sums(method) != _sums(other):
                continue
            both = [scores.methods[one.name].targets for one in (method, other)]
            pairs = ((name, *(of[name].psnr_db for of in both)) for name in both[0])
            gains = [
                f"{a - b:+.1f} dB on {t}" for t, a, b in pairs if a is not None and b is not None
            ]
            if gains:
                sentences.append(f"{method.name}: {', '.join(gains)} over {other.name}.")
    return sentences
