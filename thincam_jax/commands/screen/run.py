"""Screen experiments: from the file to the study, its run with a calibration, and its page."""

import resource
import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from thincam_jax import waveguide as wg
from thincam_jax.commands.config_file import ConfigError, slug
from thincam_jax.commands.report import Content, Page, Part, Picture, pixels_of
from thincam_jax.commands.run_folder import Progress, Run, RunFolder
from thincam_jax.commands.screen.config import (
    CalibrationConfig,
    ScreenConfig,
    ScreenMethodConfig,
    ScreenTargetConfig,
    SeeThroughConfig,
)
from thincam_jax.commands.sections import VariationConfig
from thincam_jax.commands.study.build import picture
from thincam_jax.plot import screen as plot
from thincam_jax.reconstruction import AbstractSolver, AdmmTV, Ridge, TotalVariation
from thincam_jax.studies.pictures import finding
from thincam_jax.studies.screen import (
    ModelResult,
    RaySummary,
    ScreenResult,
    ScreenRun,
    ScreenStudy,
    summarise_rays,
)
from thincam_jax.studies.screen_calibration import MEASURED, CalibrationRun, CalibrationScores

_RAYS = (
    "Side view: rays of three pixels through lens, plate (grey) and out to the object; thin lines "
    "go on to the object points of the image and its ghosts, further down with each bounce."
)
_FIELD = (
    "Each pixel is reached by one colour, and its ghosts have a shift of their own: no convolution "
    "describes this camera."
)
PUBLISHED = (
    "Ours are simulated, the published ones measured: the differences are those of the two, not of "
    "the methods. Times are with compilation, all images together."
)
_COLUMNS = (
    "What the sensor sees of single cells (row, column): columns of the measured matrix, and of "
    "the exact one."
)


def build_screen(config: ScreenConfig) -> ScreenStudy:
    """The study of a file, everything checked and images read.

    **Errors**: ConfigError, one line for each fault, beginning with its place.
    """
    cells, channels = config.object.cells, len(config.hologram.colours or ())
    pictures, faults = config.read_each(
        "targets", lambda one: picture(one, cells, channels), "path"
    )
    targets = dict(zip([target.name for target in config.targets], pictures, strict=False))
    study = ScreenStudy(
        build_cameras(config),
        build_plane(config),
        targets,
        config.noise.build(),
        {method.name: build_solver(method) for method in config.methods},
        tuple(model.build(name=model.name) for model in config.models),
        config.orders,
        config.band_samples,
        (config.hologram.object_angle, config.hologram.reference_angle),
        config.seed,
        config.name,
        config,
    )
    try:
        study.check()
    except ValueError as error:
        faults.append(f"{config.place_of('screen')}screen: {error}")
    if faults:
        raise ConfigError("\n".join(faults))
    return study


def build_plane(config: SeeThroughConfig) -> wg.ObjectPlane:
    """The cells before the camera."""
    seen = config.object
    return wg.ObjectPlane(seen.cells, seen.distance, seen.width, (seen.x, seen.y))


def build_cameras(config: SeeThroughConfig) -> tuple[wg.SeeThroughCamera, ...]:
    """The camera of each colour."""
    return tuple(_camera(config, wavelength) for wavelength in config.hologram.recorded)


def _camera(config: SeeThroughConfig, wavelength: float) -> wg.SeeThroughCamera:
    film, plate = config.hologram, config.screen
    hologram = film.build(wavelength=wavelength).processed(film.shrinkage)
    screen = wg.Screen(
        hologram,
        plate.glass_thickness,
        plate.glass_index,
        plate.top and plate.top.build(),
        plate.bottom and plate.bottom.build(),
    )
    lens = config.lens
    sensor = config.sensor.build()
    distances = lens.focal_distance, lens.lens_distance
    return wg.SeeThroughCamera(screen, sensor, *distances, tilt=np.asarray(plate.tilt))


def build_solver(method: ScreenMethodConfig) -> AbstractSolver:
    """The solver of a method of a file."""
    if method.kind == "ridge":
        return Ridge(method.ridge or 1.0)
    options = method.variation or VariationConfig()
    variation = TotalVariation(options.kind)
    return AdmmTV(options.tau, variation=variation, iterations=options.iterations)


def run_screen(study: ScreenStudy, folder: RunFolder, progress: Progress) -> ScreenResult:
    """Run a study into a folder; its result has the model that a calibration measured, too."""
    return _ScreenRun(study, folder).carry_out(progress).result


class _ScreenRun(Run):
    """A study, its calibration where the file has one, and their report."""

    result: ScreenResult

    def __init__(self, study: ScreenStudy, folder: RunFolder):
        super().__init__(study.config, folder)
        self.study, self.models, self.calibration = study, ScreenRun(study), None
        self.work += self.models.work
        if self.config.calibration is not None:
            calibration = self.config.calibration.build()
            self.calibration = CalibrationRun(study, calibration, folder.path)
            self.work += self.calibration.work
        self.add("report", self.report)

    def report(self) -> None:
        study, found = self.study, dict(self.models.result.models)
        rays, peak = study.rays(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        calibrated = None
        if self.calibration is not None:
            calibrated = self.calibration.result
            found[MEASURED] = ModelResult("by Hadamard patterns, with noise", calibrated.methods)
        result = self.result = ScreenResult(study, found)
        summary = summarise_rays(study, rays)
        ranges = {name: value for name, value in asdict(summary).items() if value is not None}
        memory = round(peak * (1 if sys.platform == "darwin" else 1024) / 1e9, 2)
        self.metrics = {
            "study": study.name,
            "kind": self.config.kind,
            "seed": study.seed,
            "rays": ranges,
            "models": {name: _scores(model) for name, model in found.items()},
            "entries_of_the_system": int(study.systems[0].values.size),
            "peak_memory_gb": memory,
        }
        drawn = {
            "rays": plot.draw_rays(study),
            "field": plot.draw_field(study, rays),
            "images": plot.draw_images(result),
            "models": plot.draw_models(result),
            "errors": plot.draw_errors(result),
        }
        if calibrated is not None:
            self.metrics["calibration"] = asdict(calibrated.scores)
            pitch = float(study.camera.sensor.pitch)
            drawn["columns"] = plot.draw_columns(pitch, calibrated.cells, calibrated.columns)
            if calibrated.images:
                drawn["distances"] = plot.draw_distances(calibrated)
        for name, figure in drawn.items():
            self.folder.save_figure(name, figure)
        for name, one in found[study.models[0].name].methods.items():
            for target, image in zip(study.targets, one.images, strict=True):
                self.folder.save_image(f"{slug(target)}--{slug(name)}", np.asarray(image))
        scores = None if calibrated is None else calibrated.scores
        self.complete(page(self.config, result, summary, scores, memory))


def _scores(model: ModelResult) -> dict[str, Any]:
    methods = {name: asdict(one.scores) for name, one in model.methods.items()}
    return {"mistake": model.mistake, "methods": methods}


def published_figures(targets: Sequence[ScreenTargetConfig]) -> dict[str, dict[str, Any]]:
    """Of each target, by method."""
    return {
        target.name: {method: one.build() for method, one in target.published.items()}
        for target in targets
    }


def page(
    config: ScreenConfig,
    result: ScreenResult,
    rays: RaySummary,
    calibration: CalibrationScores | None,
    peak: float,
) -> Page:
    """The page of a finished run; `peak`: the most memory it took, GB."""
    right, last = config.models[0].name, config.methods[-1].name
    published = published_figures(config.targets)
    images = (
        "Targets, what the sensor captures (in the colours of its pixels, turned upright), and "
        f"reconstructions with the model “{right}”."
    )
    lead = (
        f"{pixels_of(config.sensor)} behind a glass of {config.screen.glass_thickness:g} mm; "
        f"{config.object.cells[0]}×{config.object.cells[1]} cells at {config.object.distance:g} "
        f"mm, {config.orders} ghost orders, seed {config.seed}. {peak:.1f} GB of memory at most.",
        Picture("images.png", "Targets, captures, reconstructions", images),
        Picture("rays.png", "Rays in side view", _RAYS),
        Picture("field.png", "Wavelength and ghost shifts over the field", _FIELD),
        str(rays),
    )
    scored = f"PSNR after a least-squares gain and offset, by {last}."
    errors = (
        result.errors_table(),
        Picture("models.png", "Reconstructions with wrong models", f"By {last} with each model."),
        Picture("errors.png", "PSNR of targets with each model", scored),
    )
    calibrated = ()
    if calibration is not None and config.calibration is not None:
        calibrated = _calibration(config, config.calibration, calibration)
    parts = (
        Part("Beside the thesis' Table 5.1", (result.published_table(published), PUBLISHED)),
        Part("What an error of the model costs", errors, "Errors of the model"),
        Part("Calibration with Hadamard patterns", calibrated, "Calibration"),
        Part("Notes", config.notes),
    )
    return Page(lead, parts, result=finding(result.right.methods))


def _calibration(
    config: ScreenConfig, asked: CalibrationConfig, found: CalibrationScores
) -> tuple[Content, ...]:
    last, distance = config.methods[-1].name, config.object.distance
    reasons = "".join(f"; {reason}" for reason in found.fit.reasons)
    elsewhere = (
        f"Other distances by {last}: with the exact rays, with a matrix measured there, with that "
        f"of the screen fitted at {distance:g} mm, and with the screen as it was assumed before."
    )
    return (
        f"{found.frames} frames of {asked.bits} bits, {asked.display}, in {asked.order} order. The "
        f"largest entry of the matrix is {found.largest_counts:.0f} counts; its noise is "
        f"{found.noise_counts:.3f}, expected of the frames' {found.expected_noise_counts:.3f}. "
        "“measured matrix” in the tables above is a reconstruction with it.",
        Picture("columns.png", "Columns of the matrix", _COLUMNS),
        f"The screen fitted to it: {found.fit.status.replace('_', ' ')}{reasons}.",
        found.fit.table(),
        found.table(),
        Picture("distances.png", "A target at other distances", elsewhere),
    )
