"""Running a comparison of masks: captures and reconstructions of each, figures, words, a page."""

import time
from dataclasses import asdict, astuple
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import rich
import rich.table

from thincam_jax.commands.masks import figures
from thincam_jax.commands.masks.build import (
    Setup,
    best_linear,
    build_setup,
    capture,
    channels_of,
    kernels,
    strength,
    total_variation,
)
from thincam_jax.commands.masks.config import ComparedMaskConfig, MasksConfig
from thincam_jax.commands.masks.words import Case, Results, findings
from thincam_jax.commands.page import render_page
from thincam_jax.commands.run_folder import Progress, RunFolder, Step, carry_out
from thincam_jax.commands.terminal import counted, told
from thincam_jax.imaging.metrics import psnr, ssim


def compare_masks(config: MasksConfig, folder: RunFolder) -> None:
    """Run the experiment with a progress bar and print what was found."""
    with told(lambda: "interrupted; the same command starts anew."):
        setup = build_setup(config)
        with counted(config.name) as progress:
            results = Results(run_masks(setup, folder, progress), config)
    light = config.light[-1]
    table = rich.table.Table("mask", title=f"dB at {light:,.0f} electrons, total variation")
    for scene in results.scenes:
        table.add_column(scene, justify="right")
    for name in results.masks:
        scores = (results.score(name, scene, light) for scene in results.scenes)
        table.add_row(name, *(f"{score:.1f}" for score in scores))
    rich.print(table)
    print(f"report: {folder.path / 'report.html'}")


def run_masks(setup: Setup, folder: RunFolder, progress: Progress) -> dict[str, Any]:
    """Capture, reconstruct, report; returns (and writes) the metrics.

    All but the times is the same at every run of a configuration. An interrupted run is done anew.
    """
    folder.claim(setup.config)
    run = _MasksRun(setup, folder)
    carry_out(run.work, progress)
    return run.metrics


class _MasksRun:
    """A comparison on its way; `images` of total variation are by `Case`."""

    def __init__(self, setup: Setup, folder: RunFolder):
        self.setup, self.folder, self.started = setup, folder, time.time()
        config = setup.config
        self.lights = {"one wavelength": (config.wavelength,), "broadband": config.band}
        self.images: dict[Case, np.ndarray] = {}
        self.psfs: dict[str, Any] = {}  # far away, in one wavelength
        self.metrics: dict[str, Any] = {
            "study": config.name,
            "kind": config.kind,
            "seed": config.seed,
            "masks": {},
            "cases": [],
        }
        self.work = []
        for entry in config.masks:
            self.work.append(Step(f"{entry.name}: tau", partial(self.tune, entry)))
            for distance in config.object_distances:
                for colours in self.lights:
                    seen = partial(self.reconstruct, entry, distance, colours)
                    self.work.append(Step(f"{entry.name}: {distance:g} mm, {colours}", seen))
        self.work.append(Step("report", self.report))

    def key(self, *numbers: int):
        """The same noise for every mask: a better image is a better mask."""
        key = jax.random.key(self.setup.config.seed)
        for number in numbers:
            key = jax.random.fold_in(key, number)
        return key

    def stack(self, names: list[str]) -> tuple[Any, Any]:
        """Images and precisions of scenes."""
        scenes = [self.setup.scenes[name] for name in names]
        images = jnp.asarray(np.stack([scene.image for scene in scenes]), float)
        return images, jnp.asarray([scene.precision for scene in scenes], images.dtype)

    def tune(self, entry: ComparedMaskConfig) -> None:
        """τ at each light, far away and in one wavelength, and what the PSF says by itself."""
        setup, config = self.setup, self.setup.config
        psfs = kernels(setup, entry.name, (config.wavelength,), config.object_distances[0])
        self.psfs[entry.name] = psfs
        cameras, asked = channels_of(setup, entry, psfs), config.tuning
        scene, precision = self.stack([asked.scene])
        chosen = {}
        for number, electrons in enumerate(config.light):
            key = self.key(number, len(config.scenes))
            seen = capture(setup, entry, psfs, scene, electrons, key)
            start = best_linear(cameras, seen, precision)
            tried = [
                total_variation(cameras, seen, start, tau, asked.iterations) for tau in asked.tau
            ]
            scores = [psnr(np.asarray(image[0]), np.asarray(scene[0])) for image in tried]
            chosen[f"{electrons:g}"] = asked.tau[int(np.argmax(scores))]
        found = strength(setup, entry, psfs)
        self.metrics["masks"][entry.name] = {
            "family": entry.mask.family,
            "label": entry.mask.label,
            "captures": len(psfs),
            **{name: float(f"{value:.4g}") for name, value in asdict(found).items()},
            "detail_in_shot_noise": float(f"{found.in_shot_noise:.4g}"),
            "detail_in_read_noise": float(f"{found.in_read_noise:.4g}"),
            "tau": chosen,
        }

    def reconstruct(self, entry: ComparedMaskConfig, distance: float, colours: str) -> None:
        """All scenes at every light, by both methods."""
        setup, config = self.setup, self.setup.config
        near, alone = config.object_distances[1], colours == "one wavelength"
        psfs = self.psfs[entry.name]
        if distance == near or not alone:
            psfs = kernels(setup, entry.name, self.lights[colours], distance)
        cameras, names = channels_of(setup, entry, psfs), [s.name for s in config.compared]
        scenes, precision = self.stack(names)
        tau = self.metrics["masks"][entry.name]["tau"]
        for number, electrons in enumerate(config.light):
            key = self.key(number, distance == near, alone)
            seen = capture(setup, entry, psfs, scenes, electrons, key)
            linear = best_linear(cameras, seen, precision)
            options = tau[f"{electrons:g}"], config.tuning.iterations
            found = total_variation(cameras, seen, linear, *options)
            methods = {"linear": linear, "total variation": found}
            if distance == near and alone and electrons == config.light[-1]:
                far = channels_of(setup, entry, self.psfs[entry.name])
                methods["focused far"] = best_linear(far, seen, precision)
            for method, images in methods.items():
                for name, image, truth in zip(names, images, scenes, strict=True):
                    case = Case(entry.name, name, electrons, distance, colours, method)
                    self.keep(case, np.asarray(image), np.asarray(truth))

    def keep(self, case: Case, image: np.ndarray, truth: np.ndarray) -> None:
        score, similarity = psnr(image, truth), ssim(image, truth)
        self.metrics["cases"].append([*astuple(case), round(score, 3), round(similarity, 4)])
        if case.method == "total variation":
            self.images[case] = image

    def report(self) -> None:
        setup, folder = self.setup, self.folder
        results = Results(self.metrics, setup.config)
        self.metrics["findings"] = findings(results)
        figures.save_error(folder, results)
        figures.save_sheet(folder, setup, self.psfs, self.images, results)
        page = partial(render, setup.config, folder, results)
        folder.complete(self.metrics, setup.config.seed, self.started, page)


def render(
    config: MasksConfig, folder: RunFolder, results: Results, environment: dict[str, Any]
) -> str:
    """The page, with its pictures inside."""
    shown = {"command": "run", "environment": environment, "results": results, "warnings": ()}
    return render_page("masks", config, folder.path / "figures", shown)
