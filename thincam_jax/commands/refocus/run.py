"""Running a refocus experiment: one set of captures, a sweep of the focus, a report."""

from typing import Any

import numpy as np
from rich.table import Table

from thincam_jax.commands.page import number
from thincam_jax.commands.refocus import build, figures
from thincam_jax.commands.refocus.config import RefocusConfig
from thincam_jax.commands.run_folder import Progress, Run, RunFolder
from thincam_jax.commands.study.build import FileStudy
from thincam_jax.commands.study.figures import save_figure, save_image
from thincam_jax.commands.terminal import numbers
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.reconstruction import Reconstruction
from thincam_jax.reconstruction.depth.find import all_in_focus, depth_map
from thincam_jax.studies.simulate import Capture
from thincam_jax.studies.study import Method


def run_refocus(study: FileStudy, folder: RunFolder, progress: Progress) -> dict[str, Any]:
    """Capture, sweep, reconstruct and report; returns (and writes) the metrics.

    The same configuration gives the same metrics.
    """
    return _RefocusRun(study, folder).carry_out(progress)


def table(config: RefocusConfig, metrics: dict[str, Any]) -> Table:
    """Where objects were placed, and where they were found."""
    rows = [["object", "distance mm", "found mm", "error %", "axial resolution mm"]]
    keys = ("distance_mm", "found_mm", "error_percent", "axial_resolution_mm")
    for name, found in metrics["objects"].items():
        rows.append([name, *(number(found[key], 1) for key in keys)])
    return numbers(rows)


class _RefocusRun(Run):
    """A refocus experiment on its way."""

    def __init__(self, study: FileStudy, folder: RunFolder):
        super().__init__(study.config, folder)
        self.study = study
        self.captures: dict[Exposure, Capture] = {}
        self.swept: list[Reconstruction] = []
        self.pictures: dict[tuple[str, float], np.ndarray] = {}
        self.methods: dict[str, Any] = {
            m.name: {"captures": len(m.exposures), "focused_on_mm": {}} for m in study.methods
        }
        for count, exposure in enumerate(study.exposures, 1):
            self.add(f"capture {count}", self.capture, exposure)
        for count, distance in enumerate(build.sweep_distances(study), 1):
            self.add(f"{study.config.sweep.method}: distance {count}", self.sweep, distance)
        for method in study.methods:
            for distance in (target.distance for target in study.targets):
                self.add(f"{method.name}: {distance:g} mm", self.focus, method, distance)
        self.add("report", self.report)

    def capture(self, exposure: Exposure) -> None:
        self.captures[exposure] = build.take_scene(self.study, exposure)

    def sweep(self, distance: float) -> None:
        method = build.sweep_method(self.study)
        self.swept.append(build.focus_on(self.study, method, self.captures, distance))

    def focus(self, method: Method, distance: float) -> None:
        result = build.focus_on(self.study, method, self.captures, distance)
        self.pictures[method.name, distance] = np.asarray(result.image)
        self.methods[method.name]["focused_on_mm"][f"{distance:g}"] = {
            "psnr_db": build.psnr_of_objects(self.study, method, result),
            "status": result.status,
            "iterations": result.iterations or None,
        }

    def report(self) -> None:
        study, folder, asked = self.study, self.folder, self.study.config.sweep
        sweep = build.join_sweep(study, build.sweep_distances(study), self.swept)
        found = build.find_objects(study, sweep)
        self.metrics = {
            "study": study.config.name,
            "kind": study.config.kind,
            "seed": study.config.seed,
            "objects": build.object_metrics(study, found),
            "sweep": _sweep_metrics(study, sweep, found),
            "methods": self.methods,
            "warnings": study.warnings,
        }
        depth = depth_map(
            sweep, measure=asked.measure, smoothing=asked.smoothing, window=asked.window
        )
        sharp = np.asarray(all_in_focus(sweep, depth))
        save_figure(folder, "sweep", figures.draw_sweep(sweep, self.metrics["objects"]))
        figures.save_animation(folder, sweep)
        figures.save_curves(folder, asked.measure, sweep, found, self.metrics["objects"])
        white = figures.white_level(np.asarray(sweep.images))
        save_image(folder, "all-in-focus", figures.grey_levels(sharp, white))
        save_figure(folder, "depth", figures.draw_depth(sweep, depth, sharp))
        figures.save_methods(folder, study, self.pictures, self.methods)
        self.complete("refocus", findings=findings(study.config, self.metrics))


def _sweep_metrics(study: FileStudy, sweep, found) -> dict[str, Any]:
    """The focus curves as numbers."""
    curves = {}
    if found.curves is not None:
        curves = dict(zip(found.curves.labels, found.curves.curves, strict=True))
    return {
        "method": study.config.sweep.method,
        "measure": study.config.sweep.measure,
        "distances_mm": [round(float(t), 4) for t in sweep.distances],
        "slope_per_pixel": float(f"{float(sweep.slope):.6g}"),
        "curves": {
            name: [float(f"{v:.6g}") for v in curves[region]]
            for name, region in found.region_of.items()
            if region is not None
        },
    }


def findings(config: RefocusConfig, metrics: dict[str, Any]) -> list[str]:
    """What the numbers say, in sentences."""
    sentences = []
    for name, found in metrics["objects"].items():
        if found["found_mm"] is None:
            sentences.append(f"{name}, placed at {found['distance_mm']:g} mm, was not found.")
            continue
        sentences.append(
            f"{name}, placed at {found['distance_mm']:g} mm, is sharpest at "
            f"{found['found_mm']:.1f} mm ({found['error_percent']:+.1f} %)."
        )
    spans = [found["axial_resolution_mm"] for found in metrics["objects"].values()]
    distances = sorted(placed.distance for placed in config.objects)
    if len(distances) > 1:
        gap = min(b - a for a, b in zip(distances, distances[1:], strict=False))
        sentences.append(
            f"The objects stand {gap:g} mm apart or more; the depth of focus, "
            f"π t (t+d) / (β d R²), is {min(spans):.0f} to {max(spans):.0f} mm."
        )
    return sentences
