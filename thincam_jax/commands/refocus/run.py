"""Running a refocus experiment: one set of captures, a sweep of the focus, a report."""

import time
from functools import partial
from typing import Any

import numpy as np

from thincam_jax.commands.page import render_page
from thincam_jax.commands.refocus import figures
from thincam_jax.commands.refocus.build import (
    find_objects,
    focus_on,
    join_sweep,
    object_metrics,
    psnr_of_objects,
    sweep_distances,
    sweep_method,
    take_scene,
)
from thincam_jax.commands.refocus.config import RefocusConfig
from thincam_jax.commands.run_folder import Progress, RunFolder, Step, carry_out
from thincam_jax.commands.study.figures import save_figure, save_image
from thincam_jax.commands.study.study import Capture, Exposure, Method, Study
from thincam_jax.reconstruction import Reconstruction
from thincam_jax.reconstruction.depth import all_in_focus, depth_map


def run_refocus(study: Study, folder: RunFolder, progress: Progress) -> dict[str, Any]:
    """Capture, sweep, reconstruct and report; returns (and writes) the metrics.

    The same configuration gives the same metrics. An interrupted run is done anew.
    """
    folder.claim(study.config)
    run = _RefocusRun(study, folder)
    carry_out(run.work, progress)
    return run.metrics


class _RefocusRun:
    """A refocus experiment on its way.

    `work` holds the captures, the distances of the sweep, each method focused on each object, and
    the report.
    """

    def __init__(self, study: Study, folder: RunFolder):
        self.study, self.folder, self.started = study, folder, time.time()
        self.captures: dict[Exposure, Capture] = {}
        self.swept: list[Reconstruction] = []
        self.pictures: dict[tuple[str, float], np.ndarray] = {}
        self.methods: dict[str, Any] = {
            m.name: {"captures": len(m.exposures), "focused_on_mm": {}} for m in study.methods
        }
        self.metrics: dict[str, Any] = {}
        self.work = [
            Step(f"capture {number}", partial(self.capture, exposure))
            for number, exposure in enumerate(study.exposures, 1)
        ]
        name = study.config.sweep.method
        for number, distance in enumerate(sweep_distances(study), 1):
            self.work.append(Step(f"{name}: distance {number}", partial(self.sweep, distance)))
        for method in study.methods:
            for distance in (target.distance for target in study.targets):
                focus = partial(self.focus, method, distance)
                self.work.append(Step(f"{method.name}: {distance:g} mm", focus))
        self.work.append(Step("report", self.report))

    def capture(self, exposure: Exposure) -> None:
        self.captures[exposure] = take_scene(self.study, exposure)

    def sweep(self, distance: float) -> None:
        method = sweep_method(self.study)
        self.swept.append(focus_on(self.study, method, self.captures, distance))

    def focus(self, method: Method, distance: float) -> None:
        result = focus_on(self.study, method, self.captures, distance)
        self.pictures[method.name, distance] = np.asarray(result.image)
        self.methods[method.name]["focused_on_mm"][f"{distance:g}"] = {
            "psnr_db": psnr_of_objects(self.study, method, result),
            "status": result.status,
            "iterations": result.iterations or None,
        }

    def report(self) -> None:
        study, folder, asked = self.study, self.folder, self.study.config.sweep
        sweep = join_sweep(study, sweep_distances(study), self.swept)
        found = find_objects(study, sweep)
        self.metrics = {
            "study": study.config.name,
            "kind": study.config.kind,
            "seed": study.config.seed,
            "objects": object_metrics(study, found),
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
        page = partial(render, study.config, folder, self.metrics)
        folder.complete(self.metrics, study.config.seed, self.started, page)


def _sweep_metrics(study: Study, sweep, found) -> dict[str, Any]:
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


def render(
    config: RefocusConfig, folder: RunFolder, metrics: dict[str, Any], environment: dict[str, Any]
) -> str:
    """The page, with its pictures inside."""
    shown = {
        "command": "run",
        "environment": environment,
        "metrics": metrics,
        "warnings": metrics["warnings"],
        "findings": findings(config, metrics),
    }
    return render_page("refocus", config, folder.path / "figures", shown)


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
