"""Searching for a plate, what each of its numbers does, and captures through it."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from thincam_jax import waveguide as wg
from thincam_jax._core.quantity import quantities
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.plate.config import FoundConfig, PlateDesignConfig
from thincam_jax.commands.run_folder import Progress, Run, RunFolder
from thincam_jax.commands.screen.build import build_solver
from thincam_jax.commands.study.build import picture
from thincam_jax.commands.study.figures import drawing, line_style, save_figure
from thincam_jax.design import plate as plates
from thincam_jax.imaging.metrics import psnr, ssim
from thincam_jax.imaging.sensor import Sensor
from thincam_jax.studies.evaluate import rounded
from thincam_jax.studies.screen import ScreenCaptures, reconstruct_targets
from thincam_jax.units import deg, nm, um

# Of each number of a plate: its unit, and how it is told.
_QUANTITIES = quantities(plates.Plate)
NUMBERS = {
    "glass_thickness": (1.0, _QUANTITIES["glass_thickness"].label("glass")),
    "reference_angle": (deg, "recording angle, degrees"),
    "film_thickness": (um, "film, µm"),
    "index_modulation": (1.0, "index modulation"),
    "lens_distance": (1.0, _QUANTITIES["lens_distance"].label("lens to plate")),
    "focal_distance": (1.0, _QUANTITIES["focal_distance"].label("sensor to lens")),
}
ORDERS, BAND_SAMPLES = 4, 6


class PlateFolder(RunFolder):
    """The folder of a design of a plate; `found.yaml` has its sections for `kind: screen`."""

    kind = "design"
    folders = ("figures",)
    result = "design.json"


def design_plate(
    config: PlateDesignConfig, folder: PlateFolder, progress: Progress
) -> dict[str, Any]:
    """Search, simulate and report; returns (and writes) the design. Interrupted, it begins anew.

    **Errors**: ConfigError where a target cannot be read.
    """
    return _PlateRun(config, folder).carry_out(progress)


class _PlateRun(Run):
    def __init__(self, config: PlateDesignConfig, folder: PlateFolder):
        try:
            self.scenes = [picture(target, config.object.cells) for target in config.targets]
        except (ValueError, FileNotFoundError) as error:
            raise ConfigError(f"{config.place_of('targets')}targets: {error}") from None
        super().__init__(config, folder)
        sensor, seen = Sensor(config.sensor.shape, config.sensor.pitch), config.object
        cell = seen.width / seen.cells[1]
        self.viewing = plates.Viewing(sensor, seen.distance, seen.width, cell, config.snr_db)
        names = list(NUMBERS)
        low, high = ([getattr(config.plate, name)[end] for name in names] for end in (0, 1))
        self.limits = plates.PlateLimits(plates.Plate(*low), plates.Plate(*high))
        focal = low[-1] if low[-1] == high[-1] else plates.Plate().focal_distance
        self.plates = {"default": plates.Plate(focal_distance=focal)}
        self.images: dict[str, np.ndarray] = {}
        self.metrics |= {"name": config.name, "kind": config.kind, "plates": {}}
        self.add("search", self.search)
        self.add("what each number does", self.slices)
        if config.focal_distances:
            self.add("field of view against error", self.front)
        for name in ("default", "found"):
            self.add(f"captures of {name}", self.simulate, name)
        self.add("report", self.report)

    def found_within(self, limits: plates.PlateLimits):
        counts = self.config.search.model_dump()
        return plates.find_plate(
            self.viewing, limits, key=jax.random.key(self.config.seed), **counts
        )

    def search(self) -> None:
        self.plates["found"] = self.found_within(self.limits).plate
        for name, plate in self.plates.items():
            self.metrics["plates"][name] = _told(plate, plates.judge_plate(plate, self.viewing))

    def slices(self) -> None:
        ends = zip(*map(jax.tree.leaves, (self.limits.lower, self.limits.upper)), strict=True)
        free = [(n, *e) for n, e in zip(NUMBERS, ends, strict=True) if e[0] < e[1]]
        figure = Figure(figsize=(3.2 * max(1, len(free)), 3.4), layout="constrained")
        axes = figure.subplots(1, max(1, len(free)), sharey=True, squeeze=False)[0]
        for ax, (number, low, high) in zip(axes, free, strict=False):
            unit, label = NUMBERS[number]
            for k, (name, plate) in enumerate(self.plates.items()):
                places = np.linspace(float(low), float(high), 21)
                errors = [self.error(plate, number, value) for value in places]
                style = line_style(k) | {"marker": ""}
                ax.semilogy(places / unit, errors, label=name, **style)
                at = float(getattr(plate, number))
                ax.semilogy(at / unit, self.error(plate, number, at), "ko", fillstyle="none")
            ax.set_xlabel(label)
        axes[0].set_ylabel("expected error (of the variance)")
        axes[0].legend()
        save_figure(self.folder, "slices", figure)

    def error(self, plate: plates.Plate, number: str, value: float) -> float:
        changed = dataclasses.replace(plate, **{number: value})
        return float(plates.judge_plate(changed, self.viewing).error)

    def front(self) -> None:
        points = []
        for focal in self.config.focal_distances:
            limits = self.limits.lower, self.limits.upper
            ends = [dataclasses.replace(end, focal_distance=focal) for end in limits]
            default = plates.judge_plate(plates.Plate(focal_distance=focal), self.viewing)
            errors = float(default.error), self.found_within(plates.PlateLimits(*ends)).error
            points.append((float(default.field_of_view) / deg, *errors))
        self.metrics["front"] = [
            {"focal_distance_mm": f, "field_of_view_deg": v, "default_error": d, "found_error": e}
            for f, (v, d, e) in zip(self.config.focal_distances, points, strict=True)
        ]
        figure, ax = drawing((6, 4))
        fields, default, found = zip(*sorted(points), strict=True)
        ax.semilogy(fields, default, label="default but for the lens", **line_style(0))
        ax.semilogy(fields, found, label="found at that field of view", **line_style(1))
        ax.set(xlabel="field of view along y (degrees)", ylabel="expected error (of the variance)")
        ax.legend()
        save_figure(self.folder, "front", figure)

    def simulate(self, name: str) -> None:
        plate, viewing, cells = self.plates[name], self.viewing, self.config.object.cells
        camera = plate.camera(viewing.sensor)
        rays = wg.trace(camera, jnp.zeros((1, 2)), viewing.object_distance, ORDERS)
        middle = jnp.sum(rays.points[:, 0, 1] * rays.weight[:, 0]) / jnp.sum(rays.weight)
        plane = wg.ObjectPlane(
            cells,
            viewing.object_distance,
            viewing.object_width,
            jnp.stack([jnp.zeros_like(middle), middle]),
        )
        system = wg.system_operator(camera, plane, ORDERS, BAND_SAMPLES)
        light = plates.judge_plate(plate, viewing).light
        variance = plates.noise_variance(viewing, light) / light**2
        clean = system(jnp.stack([jnp.asarray(s, light.dtype) for s in self.scenes]))
        key = jax.random.key(self.config.seed)
        captures = clean + jnp.sqrt(variance) * jax.random.normal(key, clean.shape, clean.dtype)
        solver = build_solver(self.config.method)
        found = reconstruct_targets(system, solver, ScreenCaptures(captures, variance))
        self.images[name] = np.asarray(found.image, float)
        self.metrics["plates"][name]["targets"] = {
            target.name: {"psnr_db": rounded(psnr(image, scene)), "ssim": ssim(image, scene)}
            for target, image, scene in zip(
                self.config.targets, self.images[name], self.scenes, strict=True
            )
        }

    def report(self) -> None:
        save_figure(self.folder, "images", self.draw_images())
        self.folder.write("found.yaml", dump_config(self.found_config()))
        self.complete("plate", command="design", numbers=NUMBERS)

    def draw_images(self) -> Figure:
        count, half = len(self.scenes), self.viewing.object_width / 2
        figure, rows = drawing((8.4, 2.9 * count), count, 3, squeeze=False)
        for number, (row, target) in enumerate(zip(rows, self.config.targets, strict=True)):
            pictures = {"scene": self.scenes[number]}
            pictures |= {name: images[number] for name, images in self.images.items()}
            for ax, (name, image) in zip(row, pictures.items(), strict=True):
                down = half * image.shape[0] / image.shape[1]
                ax.imshow(image, cmap="gray", vmin=0, vmax=1, extent=(-half, half, down, -down))
                scores = self.metrics["plates"].get(name, {}).get("targets", {})
                score = scores.get(target.name, {}).get("psnr_db")
                told = f"{target.name}, scene" if name == "scene" else f"{name}, {score:.1f} dB"
                ax.set_title(told, fontsize="medium")
                ax.set_xlabel("mm on the object", fontsize="small")
        return figure

    def found_config(self) -> FoundConfig:
        found = self.metrics["plates"]["found"]["numbers"]
        glass, angle, film, modulation, lens, focal = (
            found[name] * unit for name, (unit, _) in NUMBERS.items()
        )
        hologram = {
            "wavelength": f"{532 * nm} mm",
            "reference_angle": f"{angle} rad",
            "thickness": f"{film} mm",
            "index_modulation": modulation,
        }
        return FoundConfig.model_validate(
            {
                "hologram": hologram,
                "screen": {"glass_thickness": f"{glass} mm"},
                "lens": {"focal_distance": f"{focal} mm", "lens_distance": f"{lens} mm"},
            }
        )


def _told(plate: plates.Plate, judged: plates.Judged) -> dict[str, Any]:
    return {
        "numbers": {n: float(getattr(plate, n)) / unit for n, (unit, _) in NUMBERS.items()},
        "error": float(judged.error),
        "light_nm": float(judged.light) / nm,
        "ghost_light": float(judged.ghost_light),
        "ghost_mm": float(judged.ghost),
        "field_of_view_deg": float(judged.field_of_view) / deg,
    }
