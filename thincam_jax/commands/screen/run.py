"""Running a screen experiment: rays, captures, and what each model of the camera gives back."""

import resource
import sys
import time
from functools import partial
from typing import Any

import numpy as np
import rich
import rich.table

from thincam_jax import waveguide as wg
from thincam_jax.commands.page import render_page
from thincam_jax.commands.run_folder import Progress, RunFolder, Step, carry_out
from thincam_jax.commands.screen import figures
from thincam_jax.commands.screen.build import (
    MISTAKES,
    Captured,
    Setup,
    build_models,
    build_setup,
    capture,
    rounded,
    undo,
)
from thincam_jax.commands.screen.calibration import Calibration
from thincam_jax.commands.screen.config import MEASURED, ScreenConfig, ScreenMethodConfig
from thincam_jax.commands.terminal import counted, told
from thincam_jax.imaging.metrics import psnr, ssim
from thincam_jax.imaging.operators import AbstractOperator, Sparse
from thincam_jax.units import deg, nm


def screen(config: ScreenConfig, folder: RunFolder) -> None:
    """Run the experiment with a progress bar and print what was found."""
    with told(lambda: "interrupted; the same command starts anew."):
        setup = build_setup(config)
        with counted(config.name) as progress:
            metrics = run_screen(setup, folder, progress)
    table = rich.table.Table("model")
    for method in config.methods:
        table.add_column(f"{method.name}, mean dB", justify="right")
    for name, model in metrics["models"].items():
        means = [result["mean_psnr_db"] for result in model["methods"].values()]
        table.add_row(name, *(f"{mean:.1f}" for mean in means))
    rich.print(table)
    print(f"report: {folder.path / 'report.html'}")


def run_screen(setup: Setup, folder: RunFolder, progress: Progress) -> dict[str, Any]:
    """Trace, capture, undo and report; returns (and writes) the metrics.

    An interrupted run is done anew.
    """
    folder.claim(setup.config)
    run = _ScreenRun(setup, folder)
    carry_out(run.work, progress)
    return run.metrics


class _ScreenRun:
    """A screen experiment on its way; images and scores are by model and method."""

    def __init__(self, setup: Setup, folder: RunFolder):
        self.setup, self.folder, self.started = setup, folder, time.time()
        self.systems: list[Sparse] = []
        self.captured: Captured | None = None
        self.calibration: Calibration | None = None
        self.found: dict[tuple[str, str], np.ndarray] = {}
        self.scores: dict[tuple[str, str], list[float]] = {}
        self.metrics: dict[str, Any] = {}
        self.models: dict[str, Any] = {}
        self.work = [Step("rays and captures", self.capture)]
        for number, model in enumerate(setup.config.models):
            does = MISTAKES[model.mistake]
            if model.glass_thickness is not None:
                does = f"{does}, with a glass of {model.glass_thickness:g} mm"
            self.models[model.name] = {"mistake": does, "methods": {}}
            for method in setup.config.methods:
                undone = partial(self.undo_by_model, number, method)
                self.work.append(Step(f"{model.name}: {method.name}", undone))
        if setup.config.calibration is not None:
            self.models[MEASURED] = {"mistake": "by Hadamard patterns, with noise", "methods": {}}
            self.work.append(Step("captures of Hadamard patterns", self.calibrate))
            for method in setup.config.methods:
                undone = partial(self.undo_by_matrix, method)
                self.work.append(Step(f"{MEASURED}: {method.name}", undone))
            self.work.append(Step("fit of the screen", self.fit))
            for distance in setup.config.calibration.distances:
                seen = partial(self.look_from, distance)
                self.work.append(Step(f"object at {distance:g} mm", seen))
        self.work.append(Step("report", self.report))

    def capture(self) -> None:
        self.systems = build_models(self.setup)
        self.captured = capture(self.setup, self.systems[0])

    def calibrate(self) -> None:
        self.calibration = Calibration(self.setup, self.systems[0], self.folder)

    def fit(self) -> None:
        assert self.calibration is not None  # an earlier step
        self.calibration.fit_screen()

    def look_from(self, distance: float) -> None:
        assert self.calibration is not None
        self.calibration.look_from(distance)

    def undo_by_model(self, number: int, method: ScreenMethodConfig) -> None:
        assert self.captured is not None  # the first step
        name = self.setup.config.models[number].name
        self.undo(name, self.systems[number], method, self.captured)

    def undo_by_matrix(self, method: ScreenMethodConfig) -> None:
        assert self.captured is not None and self.calibration is not None
        measured = self.calibration.measured
        self.undo(MEASURED, measured.reduced, method, measured.seen(self.captured))

    def undo(
        self, name: str, system: AbstractOperator, method: ScreenMethodConfig, captured: Captured
    ) -> None:
        began = time.perf_counter()
        result = undo(system, method, captured)
        images = np.asarray(result.image, float)
        images = np.moveaxis(images, 1, -1) if images.ndim == 4 else images
        seconds = time.perf_counter() - began
        scores = [psnr(i, t.image) for i, t in zip(images, self.setup.targets, strict=True)]
        key = name, method.name
        self.found[key], self.scores[key] = images, scores
        self.models[name]["methods"][method.name] = {
            "mean_psnr_db": rounded(float(np.mean(scores))),
            "seconds_per_image": round(seconds / len(images), 3),
            "status": result.status,
            "iterations": result.iterations,
            "targets": {
                target.config.name: {
                    "psnr_db": rounded(score),
                    "ssim": round(ssim(image, target.image), 4),
                }
                for target, score, image in zip(self.setup.targets, scores, images, strict=True)
            },
        }

    def report(self) -> None:
        setup, folder = self.setup, self.folder
        assert self.captured is not None
        rays = setup.rays()
        self.metrics = {
            "study": setup.config.name,
            "kind": setup.config.kind,
            "seed": setup.config.seed,
            "rays": ray_metrics(setup, rays),
            "models": self.models,
            "entries_of_the_system": int(self.systems[0].values.size),
            "peak_memory_gb": round(_peak_memory(), 2),
        }
        if self.calibration is not None:
            self.metrics["calibration"] = self.calibration.metrics
            self.calibration.save_figures()
        figures.save_rays(folder, setup)
        figures.save_field(folder, setup, rays)
        images, light = np.asarray(self.captured.images), setup.wavelengths
        figures.save_images(folder, setup, images, light, self.found, self.scores)
        figures.save_errors(folder, setup, self.scores)
        page = partial(render, setup.config, folder, self.metrics)
        folder.complete(self.metrics, setup.config.seed, self.started, page)


def _peak_memory() -> float:
    """Of the process so far, GB."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


def ray_metrics(setup: Setup, rays: wg.Rays) -> dict[str, Any]:
    """Colours, angles of the guided light, shifts of the first ghost, and how rays ended."""
    status = np.asarray(rays.status)
    index = np.asarray(setup.camera.screen.glass_index(rays.wavelength))
    sines = np.sqrt(np.sum(np.asarray(rays.guided) ** 2, axis=-1)) / index
    sound = status[0] == wg.RayStatus.OK
    ranges = {
        "wavelength_nm": np.asarray(rays.wavelength) / nm,
        "guided_angle_deg": np.arcsin(np.minimum(sines, 1)) / deg,
    }
    if setup.config.orders > 1:
        shift = np.asarray(rays.points[1] - rays.points[0])
        ranges |= {"first_ghost_down_mm": shift[..., 1], "first_ghost_right_mm": shift[..., 0]}
        sound = sound & (status[1] == wg.RayStatus.OK)
    found: dict[str, Any] = {
        name: [round(float(v), 3) for v in (values[sound].min(), values[sound].max())]
        for name, values in ranges.items()
        if sound.any()
    }
    found["status_percent"] = {
        kind.name.lower(): round(100 * float(np.mean(status == kind)), 2)
        for kind in wg.RayStatus
        if (status == kind).any()
    }
    return found


def render(
    config: ScreenConfig, folder: RunFolder, metrics: dict[str, Any], environment: dict[str, Any]
) -> str:
    """The page, with its pictures inside."""
    shown = {"command": "run", "environment": environment, "metrics": metrics, "warnings": ()}
    return render_page("screen", config, folder.path / "figures", shown)
