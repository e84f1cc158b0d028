"""Running a screen experiment: rays, captures, and what each model of the camera gives back."""

import resource
import sys
import time
from typing import Any

import numpy as np
from rich.table import Table

from thincam_jax import waveguide as wg
from thincam_jax.commands.run_folder import Progress, Run, RunFolder
from thincam_jax.commands.screen import build, figures
from thincam_jax.commands.screen.calibration import Calibration
from thincam_jax.commands.screen.config import MEASURED, ScreenConfig, ScreenMethodConfig
from thincam_jax.commands.terminal import numbers
from thincam_jax.imaging.metrics import psnr, ssim
from thincam_jax.imaging.operators import AbstractOperator, Sparse
from thincam_jax.studies.evaluate import rounded
from thincam_jax.units import deg, nm


def table(config: ScreenConfig, metrics: dict[str, Any]) -> Table:
    """Every model by every method."""
    rows = [["model", *(f"{method.name}, mean dB" for method in config.methods)]]
    for name, model in metrics["models"].items():
        means = (found["mean_psnr_db"] for found in model["methods"].values())
        rows.append([name, *(f"{mean:.1f}" for mean in means)])
    return numbers(rows)


def run_screen(setup: build.Setup, folder: RunFolder, progress: Progress) -> dict[str, Any]:
    """Trace, capture, undo and report; returns (and writes) the metrics."""
    return _ScreenRun(setup, folder).carry_out(progress)


class _ScreenRun(Run):
    """A screen experiment on its way; images and scores are by model and method."""

    captured: build.Captured
    calibration: Calibration

    def __init__(self, setup: build.Setup, folder: RunFolder):
        super().__init__(setup.config, folder)
        self.setup = setup
        self.systems: list[Sparse] = []
        self.found: dict[tuple[str, str], np.ndarray] = {}
        self.scores: dict[tuple[str, str], list[float]] = {}
        self.models: dict[str, Any] = {}
        self.add("rays and captures", self.capture)
        for number, model in enumerate(setup.config.models):
            does = build.MISTAKES[model.mistake]
            if model.glass_thickness is not None:
                does = f"{does}, with a glass of {model.glass_thickness:g} mm"
            self.models[model.name] = {"mistake": does, "methods": {}}
            for method in setup.config.methods:
                self.add(f"{model.name}: {method.name}", self.undo_by_model, number, method)
        if setup.config.calibration is not None:
            self.models[MEASURED] = {"mistake": "by Hadamard patterns, with noise", "methods": {}}
            self.add("captures of Hadamard patterns", self.calibrate)
            for method in setup.config.methods:
                self.add(f"{MEASURED}: {method.name}", self.undo_by_matrix, method)
            self.add("fit of the screen", self.fit)
            for distance in setup.config.calibration.distances:
                self.add(f"object at {distance:g} mm", self.look_from, distance)
        self.add("report", self.report)

    def capture(self) -> None:
        self.systems = build.build_models(self.setup)
        self.captured = build.capture(self.setup, self.systems[0])

    def calibrate(self) -> None:
        self.calibration = Calibration(self.setup, self.systems[0], self.folder)

    def fit(self) -> None:
        self.calibration.fit_screen()

    def look_from(self, distance: float) -> None:
        self.calibration.look_from(distance)

    def undo_by_model(self, number: int, method: ScreenMethodConfig) -> None:
        name = self.setup.config.models[number].name
        self.undo(name, self.systems[number], method, self.captured)

    def undo_by_matrix(self, method: ScreenMethodConfig) -> None:
        measured = self.calibration.measured
        self.undo(MEASURED, measured.reduced, method, measured.seen(self.captured))

    def undo(
        self,
        name: str,
        system: AbstractOperator,
        method: ScreenMethodConfig,
        captured: build.Captured,
    ) -> None:
        began = time.perf_counter()
        result = build.undo(system, method, captured)
        images = np.asarray(result.image, float)
        images = np.moveaxis(images, 1, -1) if images.ndim == 4 else images
        seconds = time.perf_counter() - began
        targets = self.setup.targets
        scores = [psnr(i, truth) for i, truth in zip(images, targets.values(), strict=True)]
        key = name, method.name
        self.found[key], self.scores[key] = images, scores
        self.models[name]["methods"][method.name] = {
            "mean_psnr_db": rounded(float(np.mean(scores))),
            "seconds_per_image": round(seconds / len(images), 3),
            "status": result.status,
            "iterations": result.iterations,
            "targets": {
                target: {"psnr_db": rounded(score), "ssim": round(ssim(image, truth), 4)}
                for (target, truth), score, image in zip(
                    targets.items(), scores, images, strict=True
                )
            },
        }

    def report(self) -> None:
        setup, folder = self.setup, self.folder
        rays, peak = setup.rays(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        self.metrics = {
            "study": setup.config.name,
            "kind": setup.config.kind,
            "seed": setup.config.seed,
            "rays": ray_metrics(setup, rays),
            "models": self.models,
            "entries_of_the_system": int(self.systems[0].values.size),
            "peak_memory_gb": round(peak * (1 if sys.platform == "darwin" else 1024) / 1e9, 2),
        }
        if setup.config.calibration is not None:
            self.metrics["calibration"] = self.calibration.metrics
            self.calibration.save_figures()
        figures.save_rays(folder, setup)
        figures.save_field(folder, setup, rays)
        images, light = np.asarray(self.captured.images), setup.wavelengths
        figures.save_images(folder, setup, images, light, self.found, self.scores)
        figures.save_errors(folder, setup, self.scores)
        self.complete("screen")


def ray_metrics(setup: build.Setup, rays: wg.Rays) -> dict[str, Any]:
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
