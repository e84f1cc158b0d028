"""Running a study: every target through every method, into a run folder."""

import time
from collections.abc import Callable
from typing import Any

from thincam_jax.commands.doctor import environment
from thincam_jax.commands.run_folder import RunFolder, to_json
from thincam_jax.commands.study import build, figures
from thincam_jax.commands.study.config import MethodConfig, StudyConfig, TargetConfig
from thincam_jax.commands.study.page import render
from thincam_jax.commands.study.response import Response, method_response
from thincam_jax.commands.study.target import Progress, examine_target, mean_psnr_of_pictures


def steps(config: StudyConfig) -> int:
    """How many times `run_study` reports progress."""
    exposures = len(build.all_settings(config))
    return len(config.targets) * (exposures + len(config.methods)) + len(config.methods) + 1


def run_study(config: StudyConfig, folder: RunFolder, progress: Progress) -> dict[str, Any]:
    """Run what the folder does not hold yet; returns (and writes) the metrics.

    The same configuration gives the same metrics: every capture's noise has its own key, from the
    seed and the capture's place in the study.
    """
    started = time.time()
    folder.claim(config)
    reconstructors: dict[tuple, Callable] = {}
    results, contrasts = {}, {}
    for index, target in enumerate(config.targets):
        stored = folder.finished(target.name)
        if stored is None:
            stored = _run_target(config, index, target, folder, reconstructors, progress)
            folder.finish(target.name, stored)
        else:
            for _ in range(len(build.all_settings(config)) + len(config.methods)):
                progress(f"{target.name}: finished before")
        results[target.name] = stored["metrics"]
        contrasts.update(stored["contrasts"])
    responses = {}
    for method in config.methods:
        progress(f"transfer function of {method.name}")
        responses[method.name] = method_response(config, method)
    metrics = _collect(config, results, responses)
    progress("report")
    _write_report(config, folder, metrics, responses, contrasts, time.time() - started)
    return metrics


def _run_target(
    config: StudyConfig,
    index: int,
    target: TargetConfig,
    folder: RunFolder,
    reconstructors: dict[tuple, Callable],
    progress: Progress,
) -> dict[str, Any]:
    """Captures, reconstructions and figures of one target."""
    first, evaluations = examine_target(config, index, target, reconstructors, progress)
    figures.save_target(folder, config, target, first, evaluations)
    contrasts = {m: e.contrast for m, e in evaluations.items() if e.contrast is not None}
    return {"metrics": {m: e.metrics for m, e in evaluations.items()}, "contrasts": contrasts}


def _collect(
    config: StudyConfig, results: dict[str, Any], responses: dict[str, Response]
) -> dict[str, Any]:
    methods = {}
    for method in config.methods:
        psnr_db = {t.name: results[t.name][method.name]["psnr_db"] for t in config.targets}
        methods[method.name] = {
            "captures": len(build.settings(config, method)),
            "mean_psnr_of_pictures_db": mean_psnr_of_pictures(config, psnr_db),
            "limits": responses[method.name].metrics,
            "targets": {t.name: results[t.name][method.name] for t in config.targets},
            "published": _published(config, method),
        }
    return {"study": config.name, "seed": config.seed, "methods": methods}


def _published(config: StudyConfig, method: MethodConfig) -> dict[str, Any]:
    published = method.published
    return {
        "psnr_db": published.psnr_db,
        "resolved_object_mm": published.resolved,
        "limit_cycles_per_mm": published.limit_cycles_per_mm,
    }


def _write_report(config, folder, metrics, responses, contrasts, seconds) -> None:
    figures.save_responses(folder, config, responses)
    if contrasts:
        figures.save_contrasts(folder, config, contrasts)
    figures.save_psf(folder, config)
    surroundings = environment(seconds)
    folder.write("environment.json", to_json({**surroundings, "seed": config.seed}))
    folder.write("report.html", render(config, folder, metrics, surroundings))
    # Last: it marks the run as complete.
    folder.write("metrics.json", to_json(metrics))
