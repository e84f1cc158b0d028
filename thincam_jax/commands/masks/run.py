"""Running a comparison of masks: captures and reconstructions of each, figures, words, a page."""

from dataclasses import asdict, astuple
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.table import Table

from thincam_jax.commands.masks import build, figures
from thincam_jax.commands.masks.config import ComparedMaskConfig, MasksConfig
from thincam_jax.commands.masks.words import Case, Results, findings
from thincam_jax.commands.run_folder import Progress, Run, RunFolder
from thincam_jax.commands.terminal import numbers
from thincam_jax.imaging.metrics import psnr, ssim


def table(config: MasksConfig, metrics: dict[str, Any]) -> Table:
    """Every mask on every scene, at the strongest light."""
    results, light = Results(metrics, config), config.light[-1]
    rows = [["mask", *results.scenes]]
    for name in results.masks:
        scores = (results.score(name, scene, light) for scene in results.scenes)
        rows.append([name, *(f"{score:.1f}" for score in scores)])
    return numbers(rows, title=f"dB at {light:,.0f} electrons, total variation")


def run_masks(setup: build.Setup, folder: RunFolder, progress: Progress) -> dict[str, Any]:
    """Capture, reconstruct, report; returns (and writes) the metrics.

    All but the times is the same at every run of a configuration.
    """
    return _MasksRun(setup, folder).carry_out(progress)


class _MasksRun(Run):
    """A comparison on its way; `images` of total variation are by `Case`."""

    def __init__(self, setup: build.Setup, folder: RunFolder):
        super().__init__(setup.config, folder)
        self.setup, config = setup, setup.config
        self.lights = {"one wavelength": (config.wavelength,), "broadband": config.band}
        self.images: dict[Case, np.ndarray] = {}
        self.psfs: dict[str, Any] = {}  # far away, in one wavelength
        self.metrics |= {
            "study": config.name,
            "kind": config.kind,
            "seed": config.seed,
            "masks": {},
            "cases": [],
        }
        for entry in config.masks:
            self.add(f"{entry.name}: tau", self.tune, entry)
            for distance in config.object_distances:
                for colours in self.lights:
                    text = f"{entry.name}: {distance:g} mm, {colours}"
                    self.add(text, self.reconstruct, entry, distance, colours)
        self.add("report", self.report)

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
        psfs = build.kernels(setup, entry.name, (config.wavelength,), config.object_distances[0])
        self.psfs[entry.name] = psfs
        cameras, asked = build.channels_of(setup, entry, psfs), config.tuning
        scene, precision = self.stack([asked.scene])
        chosen = {}
        for number, electrons in enumerate(config.light):
            key = self.key(number, len(config.scenes))
            seen = build.capture(setup, entry, psfs, scene, electrons, key)
            start = build.best_linear(cameras, seen, precision)
            tried = [
                build.total_variation(cameras, seen, start, tau, asked.iterations)
                for tau in asked.tau
            ]
            scores = [psnr(np.asarray(image[0]), np.asarray(scene[0])) for image in tried]
            chosen[f"{electrons:g}"] = asked.tau[int(np.argmax(scores))]
        found = build.strength(setup, entry, psfs)
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
            psfs = build.kernels(setup, entry.name, self.lights[colours], distance)
        cameras, names = build.channels_of(setup, entry, psfs), [s.name for s in config.compared]
        scenes, precision = self.stack(names)
        tau = self.metrics["masks"][entry.name]["tau"]
        for number, electrons in enumerate(config.light):
            key = self.key(number, distance == near, alone)
            seen = build.capture(setup, entry, psfs, scenes, electrons, key)
            linear = build.best_linear(cameras, seen, precision)
            options = tau[f"{electrons:g}"], config.tuning.iterations
            found = build.total_variation(cameras, seen, linear, *options)
            methods = {"linear": linear, "total variation": found}
            if distance == near and alone and electrons == config.light[-1]:
                far = build.channels_of(setup, entry, self.psfs[entry.name])
                methods["focused far"] = build.best_linear(far, seen, precision)
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
        self.complete("masks", results=results)
