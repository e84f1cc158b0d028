"""Running a study: every target through every method, into a run folder."""

from typing import Any

from rich.table import Table

from thincam_jax.commands.page import number
from thincam_jax.commands.run_folder import Progress, Run, RunFolder
from thincam_jax.commands.study import figures
from thincam_jax.commands.study.build import take
from thincam_jax.commands.study.config import StudyConfig
from thincam_jax.commands.study.evaluate import Evaluation, evaluate_method, mean_psnr_of_pictures
from thincam_jax.commands.study.response import Response, method_response
from thincam_jax.commands.study.study import Capture, Exposure, Method, Study, Target
from thincam_jax.commands.terminal import numbers

# What two methods share that add and subtract the same captures in the same way.
_CAPTURES = ("shots", "synthesis", "phases", "steps", "harmonics")


def run_study(study: Study, folder: RunFolder, progress: Progress) -> dict[str, Any]:
    """Run what the folder does not hold yet; returns (and writes) the metrics.

    The same configuration gives the same metrics: every capture's noise has its own key, from the
    seed and the capture's place in the study.
    """
    return _StudyRun(study, folder).carry_out(progress)


def table(config: StudyConfig, metrics: dict[str, Any]) -> Table:
    """Every method beside what was published of it."""
    rows = [["method", "PSNR dB", "published", "resolved mm", "published", "cut-off /mm"]]
    for name, method in metrics["methods"].items():
        published = method["published"]
        told = [
            number(method["mean_psnr_of_pictures_db"], 1),
            number(published["psnr_db"], 1),
            number(resolved(method), 2),
            number(published["resolved_object_mm"], 2),
            number(method["limits"]["cut_off_cycles_per_mm"], 1),
        ]
        rows.append([name, *told])
    return numbers(rows)


class _StudyRun(Run):
    """A study on its way; `results` are by target, `evaluations` those of the target at hand."""

    def __init__(self, study: Study, folder: RunFolder):
        super().__init__(study.config, folder)
        self.study = study
        self.captures: dict[Exposure, Capture] = {}
        self.evaluations: dict[str, Evaluation] = {}
        self.results: dict[str, dict[str, Any]] = {}
        self.responses: dict[str, Response] = {}
        for target in study.targets:
            stored = folder.finished(target.name)
            if stored is not None:
                self.results[target.name] = stored
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
        self.complete("study", findings=findings(study.config, self.metrics))

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


def findings(config: StudyConfig, metrics: dict[str, Any]) -> list[str]:
    """What the numbers say, in sentences, beside what was published."""
    sentences = []
    for name, method in metrics["methods"].items():
        published = method["published"]
        mean, stated = method["mean_psnr_of_pictures_db"], published["psnr_db"]
        if mean is not None and stated is not None:
            sentences.append(
                f"{name}: {mean:.1f} dB on average over the pictures, published {stated:.1f} dB "
                f"({mean - stated:+.1f} dB)."
            )
        own, stated = resolved(method), published["resolved_object_mm"]
        if own is not None and stated is not None:
            word = "finer" if own < 0.97 * stated else "coarser"
            word = "the same within 3 %" if abs(own / stated - 1) <= 0.03 else word
            sentences.append(
                f"{name}: resolves a line pair of {own:.2f} mm on the object, published "
                f"{stated:.2f} mm: {word}."
            )
    sentences += _gains(config, metrics)
    ranked = sorted(
        (r, name) for name, m in metrics["methods"].items() if (r := resolved(m)) is not None
    )
    if len(ranked) > 1:
        order = ", ".join(f"{name} ({period:.2f} mm)" for period, name in ranked)
        sentences.append(f"From finest to coarsest on the chart: {order}.")
    return sentences


def resolved(method: dict[str, Any]) -> float | None:
    """The finest line pair on the object that a method resolves, mm; of the first chart."""
    for target in method["targets"].values():
        if target["resolved"] is not None:
            return target["resolved"]["object_mm"]
    return None


def _gains(config: StudyConfig, metrics: dict[str, Any]) -> list[str]:
    """What total variation adds to the Wiener synthesis of the same captures."""
    sentences = []
    for method in (m for m in config.methods if m.kind == "admm_tv"):
        for other in (m for m in config.methods if m.kind == "wiener"):
            if any(getattr(other, key) != getattr(method, key) for key in _CAPTURES):
                continue
            pairs = (
                (t.name, *(metrics["methods"][m.name]["targets"][t.name]["psnr_db"] for m in pair))
                for t in config.targets
                for pair in [(method, other)]
            )
            gains = [f"{a - b:+.1f} dB on {t}" for t, a, b in pairs if None not in (a, b)]
            if gains:
                sentences.append(f"{method.name}: {', '.join(gains)} over {other.name}.")
    return sentences
