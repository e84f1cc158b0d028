"""Running a refocus experiment: one set of captures, a sweep of the focus, a report."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from thincam_jax.commands.doctor import environment
from thincam_jax.commands.refocus import build as study
from thincam_jax.commands.refocus import figures as figures
from thincam_jax.commands.refocus.config import RefocusConfig
from thincam_jax.commands.refocus.page import render
from thincam_jax.commands.run_folder import RunFolder, to_json
from thincam_jax.reconstruction.depth import all_in_focus, depth_map

Progress = Callable[[str], None]


def steps(config: RefocusConfig) -> int:
    """How many times `run_refocus` reports progress."""
    captures = len(study.all_settings(config))
    return captures + config.sweep.count + len(config.methods) * len(config.objects) + 1


def run_refocus(config: RefocusConfig, folder: RunFolder, progress: Progress) -> dict[str, Any]:
    """Capture, sweep, reconstruct and report; returns (and writes) the metrics.

    The same configuration gives the same metrics. An interrupted run is done anew.
    """
    started = time.time()
    folder.claim(config)
    planes = study.build_planes(config)
    captures = study.Captures({}, {})
    for number, setting in enumerate(study.all_settings(config)):
        progress(f"capture {number + 1}")
        image, variance = study.take(config, planes, number, setting)
        captures.images[setting], captures.variances[setting] = image, variance
    name = config.sweep.method
    sweep = study.run_sweep(config, captures, lambda n: progress(f"{name}: distance {n}"))
    found = study.find_objects(config, sweep)
    pictures, methods = _focus(config, captures, planes, progress)
    metrics = {
        "study": config.name,
        "kind": config.kind,
        "seed": config.seed,
        "objects": study.object_metrics(config, found),
        "sweep": _sweep_metrics(config, sweep, found),
        "methods": methods,
    }
    progress("report")
    depth = depth_map(
        sweep,
        measure=config.sweep.measure,
        smoothing=config.sweep.smoothing,
        window=config.sweep.window,
    )
    sharp = np.asarray(all_in_focus(sweep, depth))
    figures.save_sweep(folder, sweep, metrics["objects"])
    figures.save_animation(folder, sweep)
    figures.save_curves(folder, config, sweep, found, metrics["objects"])
    figures.save_depth(folder, sweep, depth, sharp)
    figures.save_methods(folder, config, pictures, metrics["methods"])
    surroundings = environment(time.time() - started)
    folder.write("environment.json", to_json({**surroundings, "seed": config.seed}))
    folder.write("report.html", render(config, folder, metrics, surroundings))
    folder.write("metrics.json", to_json(metrics))
    return metrics


def _focus(config, captures, planes, progress):
    """Every method focused on every object: pictures, and what goes into metrics.json."""
    pictures: dict[tuple[str, float], np.ndarray] = {}
    metrics: dict[str, Any] = {}
    for method in config.methods:
        focused = {}
        for placed in config.objects:
            progress(f"{method.name}: {placed.distance:g} mm")
            result = study.reconstruct_at(config, method, captures, placed.distance)
            pictures[method.name, placed.distance] = np.asarray(result.image)
            focused[f"{placed.distance:g}"] = {
                "psnr_db": study.evaluate(config, method, planes, result),
                "status": result.status,
                "iterations": result.iterations or None,
            }
        metrics[method.name] = {
            "captures": len(study.method_settings(config, method)),
            "focused_on_mm": focused,
        }
    return pictures, metrics


def _sweep_metrics(config: RefocusConfig, sweep, found) -> dict[str, Any]:
    """The focus curves as numbers."""
    found_curves = found.curves
    curves = {}
    if found_curves is not None:
        curves = dict(zip(found_curves.labels, found_curves.curves, strict=True))
    return {
        "method": config.sweep.method,
        "measure": config.sweep.measure,
        "distances_mm": [round(float(t), 4) for t in sweep.distances],
        "slope_per_pixel": float(f"{float(sweep.slope):.6g}"),
        "curves": {
            name: [float(f"{v:.6g}") for v in curves[region]]
            for name, region in found.region_of.items()
            if region is not None
        },
    }
