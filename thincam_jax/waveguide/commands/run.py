"""Screen experiments: from the file to the study, its run with a calibration, and its page."""

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np

from thincam_jax import waveguide as wg
from thincam_jax._core.memory import peak_memory, readable
from thincam_jax._core.quantity import FieldError
from thincam_jax._core.text import slug
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.pictures import published_figures
from thincam_jax.commands.report import Content, Page, Part, Picture, pixels_of
from thincam_jax.commands.run_folder import Progress, Run, RunFolder
from thincam_jax.commands.study.build import build_optics, picture
from thincam_jax.lensless.exposures import Exposure
from thincam_jax.studies.pictures import PUBLISHED, finding
from thincam_jax.waveguide import plot
from thincam_jax.waveguide.commands.config import CalibrationConfig, ScreenConfig, SeeThroughConfig
from thincam_jax.waveguide.display import DisplayLight
from thincam_jax.waveguide.lens import lens_views
from thincam_jax.waveguide.studies.calibration import MEASURED, CalibrationRun, CalibrationScores
from thincam_jax.waveguide.studies.mask import ScreenMask
from thincam_jax.waveguide.studies.screen import (
    ModelResult,
    RaySummary,
    ScreenResult,
    ScreenRun,
    ScreenStudy,
    screen_metrics,
    summarise_rays,
)
from thincam_jax.waveguide.system import entries_of_a_ray


def build_screen(config: ScreenConfig) -> ScreenStudy:
    """The study of a file, everything checked and images read.

    **Errors**: ConfigError, one line for each fault, beginning with its place.
    """
    cells, channels = config.object.cells, len(config.hologram.colours or ())
    pictures, faults = config.read_each(
        "targets", lambda one: picture(one, cells, channels), "path"
    )
    display = None
    try:
        display = build_display(config)
    except FieldError as error:
        faults.append(f"{config.place_of(*error.place)}{'.'.join(map(str, error.place))}: {error}")
    targets = dict(zip([target.name for target in config.targets], pictures, strict=False))
    study = ScreenStudy(
        build_cameras(config),
        build_plane(config),
        targets,
        config.noise.build(),
        {method.name: method.build() for method in config.methods},
        tuple(model.build(name=model.name) for model in config.models),
        config.orders,
        config.band_samples,
        (config.hologram.object_angle, config.hologram.reference_angle),
        config.seed,
        config.name,
        build_mask(config),
        tuple(one.build() for one in config.hologram.responses or ()),
        config,
        display,
        config.display_frames,
    )
    try:
        study.check()
    except ValueError as error:
        faults.append(f"{config.place_of('screen')}screen: {error}")
    if faults:
        raise ConfigError("\n".join(faults))
    return study


def build_mask(config: ScreenConfig) -> ScreenMask | None:
    """The mask in the lens' place, if there is one."""
    if (mask := config.mask) is None:
        return None
    numbers = mask.beta or 0.0, 0.0, mask.distance, config.hologram.recorded[0], mask.width
    return mask.build(mask=build_optics(mask, config.sensor, Exposure(*numbers))[0])


def build_display(config: SeeThroughConfig) -> DisplayLight | None:
    """The display's light, if there is any.

    **Errors**: FieldError for a pattern that cannot be read, or is of other pixels.
    """
    if (given := config.display_light) is None:
        return None
    try:
        found = given.build()
        found.irradiance(config.sensor.shape, 1.0)  # refuses a pattern of other pixels
        return found
    except (OSError, ValueError) as error:
        raise FieldError(str(error), "display_light", "path") from None


def build_plane(config: SeeThroughConfig) -> wg.ObjectPlane:
    """The cells before the camera."""
    seen = config.object
    return wg.ObjectPlane(seen.cells, seen.distance, seen.width, (seen.y, seen.x))


def build_cameras(config: SeeThroughConfig) -> tuple[wg.SeeThroughCamera, ...]:
    """The camera of each colour."""
    film = config.hologram
    films = [film.build(wavelength=one).processed(film.shrinkage) for one in film.recorded]
    screens = [config.screen.build(hologram=one) for one in films]
    others: dict[str, Any] = config.optics | {"tilt": np.asarray(config.screen.tilt)}
    sensor = config.sensor.build()
    return tuple(wg.SeeThroughCamera(screen, sensor, **others) for screen in screens)


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
        rays, memory = study.rays(), peak_memory()
        calibrated = None
        if self.calibration is not None:
            calibrated = self.calibration.result
            found[MEASURED] = ModelResult("by Hadamard patterns, with noise", calibrated.methods)
        result = self.result = ScreenResult(study, found)
        summary = summarise_rays(study, rays)
        kind = {"study": study.name, "kind": self.config.kind, "seed": study.seed}
        self.metrics = kind | screen_metrics(result, summary) | {"peak_memory_gb": memory}
        drawn = plot.draw_result(result, rays)
        if calibrated is not None:
            self.metrics["calibration"] = asdict(calibrated.scores)
            drawn |= plot.draw_calibration(calibrated)
        for name, figure in drawn.items():
            self.folder.save_figure(name, figure)
        for name, one in found[study.models[0].name].methods.items():
            for target, image in zip(study.targets, one.images, strict=True):
                self.folder.save_image(f"{slug(target)}--{slug(name)}", np.asarray(image))
        self.complete(page(result, summary, calibrated and calibrated.scores, memory))


def page(
    result: ScreenResult,
    rays: RaySummary,
    calibration: CalibrationScores | None,
    peak: float | None,
) -> Page:
    """The page of a finished run; `peak`: the most memory it took, GB, where that is known."""
    config: ScreenConfig = result.study.config
    last = config.methods[-1].name
    published = published_figures(config.targets)
    mask, captions = config.mask, plot.captions(result.study)
    behind = "" if mask is None else f"{mask.label}, {mask.distance:g} mm before it, "
    memory = "" if peak is None else f" {peak:.1f} GB of memory at most."
    lead = (
        f"{pixels_of(config.sensor)}, {behind}behind a glass of {config.screen.glass_thickness:g} "
        f"mm; {config.object.cells[0]}×{config.object.cells[1]} cells at "
        f"{config.object.distance:g} mm, {config.orders} ghost orders, seed {config.seed}.{memory}",
        Picture("images.png", "Targets, captures, reconstructions", captions["images"]),
        Picture("rays.png", "Rays in side view", captions["rays"]),
        Picture(
            "field.png", "Wavelengths, ghost shifts or shadows over the field", captions["field"]
        ),
        str(rays),
        _display(result.study),
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
    known = any(published.values())
    title, note = ("Beside the thesis' Table 5.1", PUBLISHED) if known else ("Pictures", "")
    parts = (
        Part(title, (result.published_table(published), note)),
        Part("What an error of the model costs", errors, "Errors of the model"),
        Part("Calibration with Hadamard patterns", calibrated, "Calibration"),
        Part("Notes", config.notes),
    )
    return Page(lead, parts, result=finding(result.right.methods))


def _display(study: ScreenStudy) -> str:
    """The light of a display behind the plate in a sentence; empty without one."""
    if study.display_light is None:
        return ""
    light = f"adds {float(study.background.mean()):.3g} of a white object's light"
    return (
        f"A display behind the plate {light}; exposures of it, subtracted: {study.display_frames}."
    )


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
        Picture("columns.png", "Columns of the matrix", plot.COLUMNS_CAPTION),
        f"The screen fitted to it: {found.fit.status.replace('_', ' ')}{reasons}.",
        found.fit.table(),
        found.table(),
        Picture("distances.png", "A target at other distances", elsewhere),
    )


def rays(asked: Any, setup: Any) -> Iterator[str]:
    """Rays of a see-through camera, and entries of its matrix."""
    (rows, columns), parts = asked.sensor.shape, asked.band_samples or 1
    if getattr(asked, "mask", None) is not None:
        size = rows * columns * asked.object.cells[0] * asked.object.cells[1]
        yield f"matrix of each model: {size / 1e6:.3g} million entries, {readable(4 * size)}"
        return
    cameras = build_cameras(asked) if setup is None else setup.cameras
    plane = build_plane(asked) if setup is None else setup.plane
    points = len(lens_views(cameras[0], [plane], asked.orders))
    traced = rows * columns * asked.orders * parts * len(cameras) * points
    entries = traced * entries_of_a_ray(cameras[0], plane)
    lens = f", {points} points of the lens" if points > 1 else ""
    yield (
        f"matrix of each model: {rows}×{columns} pixels, {asked.orders} orders, {parts} parts of "
        f"the band{lens}: {traced / 1e6:.3g} million rays, at most {entries / 1e6:.3g} million "
        f"entries, {readable(12 * entries)}"  # a number and two indices, four bytes each
    )
