"""Running a refocus experiment: the study into a folder, with a report."""

from dataclasses import asdict
from typing import Any

import numpy as np

from thincam_jax.commands.config_file import slug
from thincam_jax.commands.refocus import figures, report
from thincam_jax.commands.refocus.build import FileRefocus
from thincam_jax.commands.run_folder import Progress, Run, RunFolder
from thincam_jax.commands.study.figures import save_figure, save_image
from thincam_jax.studies.refocus import RefocusResult, RefocusRun


def run_refocus(refocusing: FileRefocus, folder: RunFolder, progress: Progress) -> RefocusResult:
    """Capture, sweep, reconstruct and report; the same configuration gives the same metrics."""
    run = _RefocusRun(refocusing, folder)
    run.carry_out(progress)
    return run.running.result


class _RefocusRun(Run):
    """A refocusing study and its report."""

    def __init__(self, refocusing: FileRefocus, folder: RunFolder):
        super().__init__(refocusing.config, folder)
        self.running = RefocusRun(refocusing)
        self.work += self.running.work
        self.add("report", self.report)

    def report(self) -> None:
        folder, result = self.folder, self.running.result
        study = result.refocusing.study
        self.metrics = {
            "study": study.name,
            "kind": self.config.kind,
            "seed": study.seed,
            "objects": {name: asdict(one) for name, one in result.objects.items()},
            "sweep": _sweep_metrics(result),
            "methods": {name: asdict(one) for name, one in result.methods.items()},
            "warnings": study.warnings,
        }
        places = {name: one.distance_mm for name, one in result.objects.items()}
        save_figure(folder, "sweep", figures.draw_sweep(result.sweep, places))
        folder.write("figures/sweep.webp", figures.animate_sweep(result.sweep))
        save_figure(folder, "focus", figures.draw_curves(result))
        white = figures.white_level(np.asarray(result.sweep.images))
        save_image(folder, "all-in-focus", figures.grey_levels(result.sharp, white))
        save_figure(folder, "depth", figures.draw_depth(result.sweep, result.depth, result.sharp))
        for (name, distance), image in result.images.items():
            shown = figures.grey_levels(image, figures.white_level(image))
            save_image(folder, f"{slug(name)}--{distance:g}mm", shown)
        save_figure(folder, "methods", figures.draw_methods(result))
        self.complete(report.page(self.config, result, findings(result)))


def _sweep_metrics(result: RefocusResult) -> dict[str, Any]:
    """The focus curves as numbers."""
    sweep, asked = result.sweep, result.refocusing.sweep
    curves = {name: result.found.curve(name) for name in result.objects}
    return {
        "method": asked.method,
        "measure": asked.measure,
        "distances_mm": [round(float(t), 4) for t in sweep.distances],
        "slope_per_pixel": float(f"{float(sweep.slope):.6g}"),  # pyright: ignore[reportArgumentType]
        "curves": {
            name: [float(f"{v:.6g}") for v in curve]
            for name, curve in curves.items()
            if curve is not None
        },
    }


def findings(result: RefocusResult) -> list[str]:
    """What the numbers say, in sentences."""
    sentences = []
    for name, found in result.objects.items():
        if found.found_mm is None:
            sentences.append(f"{name}, placed at {found.distance_mm:g} mm, was not found.")
            continue
        sentences.append(
            f"{name}, placed at {found.distance_mm:g} mm, is sharpest at "
            f"{found.found_mm:.1f} mm ({found.error_percent:+.1f} %)."
        )
    spans = [found.axial_resolution_mm for found in result.objects.values()]
    distances = sorted(target.distance for target in result.refocusing.study.targets)
    if len(distances) > 1:
        gap = min(b - a for a, b in zip(distances, distances[1:], strict=False))
        sentences.append(
            f"The objects stand {gap:g} mm apart or more; the depth of focus, "
            f"π t (t+d) / (β d R²), is {min(spans):.0f} to {max(spans):.0f} mm."
        )
    return sentences
