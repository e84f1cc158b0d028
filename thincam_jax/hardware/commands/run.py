"""Reconstruction of a store of captures: an image or a system matrix, and a report."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from thincam_jax._core.quantity import FieldError
from thincam_jax._core.table import Table
from thincam_jax._core.text import slug
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.mask import MaskConfig, built_mask
from thincam_jax.commands.pictures import published_figures
from thincam_jax.commands.report import Page, Part, Picture
from thincam_jax.commands.run_folder import Progress, Run, RunFolder
from thincam_jax.commands.sections import PHASES, PictureConfig, SensorConfig, build_solver
from thincam_jax.commands.study.build import build_optics, picture
from thincam_jax.hardware import plot
from thincam_jax.hardware.commands.config import CaptureConfig
from thincam_jax.hardware.studies.images import frame_solver
from thincam_jax.hardware.studies.pairs import object_grid, truth, write_pairs
from thincam_jax.hardware.studies.registration import (
    ShotPlace,
    ShotPlaces,
    read_distances,
    register_shots,
    standing_at,
)
from thincam_jax.hardware.studies.rig import (
    FrameAgreement,
    MatrixAgreement,
    RigFrames,
    align_display,
    calibrated,
    compare_frames,
    reconstruct_pictures,
    recover_to,
)
from thincam_jax.imaging.encoding import as_picture
from thincam_jax.imaging.metrics import psnr
from thincam_jax.imaging.operators import Sparse
from thincam_jax.lensless.exposures import Exposure, Exposures
from thincam_jax.measured import write_image
from thincam_jax.measured.calibration.alignment import Alignment
from thincam_jax.plot.pictures import draw_columns
from thincam_jax.studies.evaluate import rounded
from thincam_jax.studies.pictures import PUBLISHED, beside, finding
from thincam_jax.studies.study import Method, Study, Synthesis, Target

_MATRIX = (
    "The matrix is in matrix.zarr, to be given as `matrix` of a file that captures pictures or a "
    "scene; in Python it is read by `thincam_jax.measured.calibration.read_matrix`."
)
SHOWN_PAIRS = 2  # pictures of a data set that a page shows
_PLACES = (
    "Distance of mask and sensor, and the mask's middle beside the sensor's, by the images of the "
    "single shots. The first shot is taken to stand where it reads."
)


@dataclass(frozen=True)
class Taken:
    """Captured frames of a store.

    - `seen`: frames, some only of a Hadamard plan; its camera is that of a virtual rig.
    - `labels`: words for what was shown for each. `seconds`: duration of the acquisition's steps,
      by name.
    - `exposures`: s. `calibration`: HadamardCaptures or GreyLevels, of such plans; the Acquisition
      of several pictures on an aligned monitor.
    """

    seen: RigFrames
    labels: list[str]
    shown: list[np.ndarray]
    exposures: list[float]
    seconds: Mapping[str, float]
    calibration: Any = None


def run_captures(
    config: CaptureConfig, taken: Taken, folder: RunFolder, progress: Progress
) -> dict[str, Any]:
    """Reconstruct, compare with direct simulation where the rig was virtual, and report.

    Returns (and writes) the metrics.
    """
    return _CaptureRun(config, taken, folder).carry_out(progress).metrics


class _CaptureRun(Run):
    """Captures on their way to an image or a matrix; `metrics` grows with the steps."""

    def __init__(self, config: CaptureConfig, taken: Taken, folder: RunFolder):
        super().__init__(config, folder)
        self.taken = taken
        self.agreement: FrameAgreement | MatrixAgreement | None = None
        self.found = f"{len(taken.labels)} frames, at most {taken.seen.frames.max():.0f} counts."
        self.table: Table | None = None  # of pictures
        self.places: ShotPlaces | None = None  # as registered
        self.metrics |= {
            "study": config.name,
            "kind": config.kind,
            "rig": config.rig,
            "plan": config.plan.kind,
            "seconds": {name: round(s, 4) for name, s in taken.seconds.items()},
        }
        self.add("captures", self.show)
        kind, table, place = config.plan.kind, self.linearise, self.align
        steps = {"hadamard": self.recover, "grey_levels": table, "alignment": place}
        if kind in steps:
            self.add("system matrix" if kind == "hadamard" else kind.replace("_", " "), steps[kind])
        elif config.matrix is not None:
            self.add("images", self.look)
        elif config.makes_pairs:
            self.add("pairs", self.pair_up)
        elif config.plan.kind != "psf_stack" and config.optics is not None:
            self.add("image", self.reconstruct)
        self.add("report", self.report)

    def report(self) -> None:
        if self.agreement is not None:
            self.metrics["agreement"] = asdict(self.agreement)
            self.found = str(self.agreement)
        if self.places is not None:
            self.found = f"{self.found} {str(self.places).capitalize()}"
        self.complete(self.page())

    def page(self) -> Page:
        config, taken, agreement, table = self.config, self.taken, self.agreement, self.table
        beside_it = ", beside the scene and a direct simulation with other noise, and without"
        images = f"What is reconstructed{beside_it if agreement else ''}."
        seen = "What the sensor sees of single cells (row, column)"
        seen += ": measured, and by direct simulation. " if agreement else ". "
        exposures = ", ".join(f"{1000 * one:g}" for one in taken.exposures)
        devices = "; ".join(f"{role} {driver}" for role, (driver, _) in config.drivers.items())
        lead = (
            f"Plan {config.plan.kind.replace('_', ' ')} on a {config.rig} rig: {devices}; exposure "
            f"{exposures} ms.",
            Picture("images.png", "Reconstructions", images),
            Picture("columns.png", "Columns of the system matrix", seen + _MATRIX),
            Picture("shown.png", "Patterns shown", "What the display showed."),
            Picture("frames.png", "Frames taken", "What the camera took, without the dark frame."),
        )
        found = {} if agreement is None else asdict(agreement)
        rows = [(name.replace("_", " "), str(value).strip("[]")) for name, value in found.items()]
        explained = "Differences over the noise's standard deviation: 1 is agreement within it."
        compared = Part("Beside direct simulation", (Table(("number", "found"), rows), explained))
        parts = [compared] if rows else []
        if self.places is not None:
            parts += [Part("Registration of the shots", (self.places.table(), _PLACES))]
        parts += [Part("Beside what was published", (table, PUBLISHED))] if table else []
        if taken.seconds:
            parts += [
                Part("Time", (Picture("seconds.png", "Time of the steps", "Of all frames."),))
            ]
        return Page(lead, [*parts, Part("Notes", config.notes)], result=self.found)

    def show(self) -> None:
        taken, config, folder, seen = self.taken, self.config, self.folder, self.taken.seen
        frames = plot.draw_frames(seen.frames, taken.labels, config.camera.pitch, seen.lit)
        folder.save_figure("frames", frames)
        if taken.shown:
            shown = plot.draw_patterns(taken.shown, taken.labels, config.display.pitch)
            folder.save_figure("shown", shown)
        if config.plan.kind == "scene":
            write_image(folder.path / "scene.tif", seen.frames)
        if seen.variance is not None:
            write_image(folder.path / "variance.tif", seen.variance[None])
        if taken.seconds:
            folder.save_figure("seconds", plot.draw_seconds(taken.seconds))

    def reconstruct(self) -> None:
        seen, config = self.taken.seen, self.config
        study = self.study((seen.frames.shape[1], seen.frames.shape[2]))
        width, places = study.config.object.width, None
        by_hand = config.stage is not None and config.stage.driver == "manual"
        wanted = by_hand if (given := config.reconstruction.registration) is None else given
        if wanted and len(study.methods[0].shots) > 1 and config.plan.mosaic is None:
            places = register_shots(study, seen.frames, width, seen.bayer)
            study = standing_at(study, places)
            self.places, self.metrics["registration"] = places, asdict(places)["shots"]
        solve = frame_solver(study, width, seen.variance, seen.bayer)
        captured = solve(seen.frames)
        images, scores = {"captured": as_picture(np.asarray(captured.image, float))}, {}
        if seen.camera is not None and config.virtual is not None:
            whole = self.study(config.virtual.sensor)
            whole = whole if places is None else standing_at(whole, places)
            found = compare_frames(whole, seen, solve, captured, config.seed)
            images, scores, self.agreement = found.images, found.psnr_db, found.agreement
            self.metrics["psnr_db"] = scores
        pitch = float(np.asarray(captured.pitch))
        self.folder.save_figure("images", plot.draw_images(images, pitch, scores))
        for name, image in images.items():
            self.folder.save_image(name.replace(" ", "-"), plot.stretched(image))
        self.metrics["status"] = captured.status
        self.metrics["object_pixel_mm"] = pitch

    def pair_up(self) -> None:
        """All pictures and their captures as a data set, and images of the first ones."""
        frames, config, folder = self.taken.seen.frames, self.config, self.folder.path / "pairs"
        study = self.study((frames.shape[1], frames.shape[2]))
        width = study.config.object.width
        stated = config.licence or "not stated", config.held_out or 0
        found = write_pairs(folder, study, self.taken.calibration, width, *stated)
        solve, images, scores = frame_solver(study, width), {}, {}
        solved = [as_picture(np.asarray(solve(frame[None]).image)) for frame in frames]
        grid = object_grid(study, (solved[0].shape[0], solved[0].shape[1]))
        for target, image in zip(study.targets, solved, strict=False):
            light, seen = truth(target, grid), f"{target.name}, seen"
            images |= {target.name: light, seen: image}
            scores[seen] = rounded(psnr(image, light))
        self.folder.save_figure("images", plot.draw_images(images, float(grid.pitch), scores))
        self.metrics |= {"pairs": found, "psnr_db": scores}
        self.found = f"{len(study.targets)} pairs; next: thincam evaluate {folder}"

    def study(self, shape: tuple[int, int]) -> Study:
        """The study of frames of a shape, its shots where the stage read.

        **Errors**: ConfigError for two shots of one mask at one place.
        """
        config, positions = self.config, self.taken.seen.positions
        study = build_study(config, shape)
        exposures = study.methods[0].exposures
        single = len(positions) == len(exposures) and exposures.layout is None
        if not single or config.optics is None:  # several frames of an exposure, or all in one
            return study
        phases = study.methods[0].phases
        read = read_distances(config.optics.distance, positions, phases)
        shots = tuple(ShotPlace(one, one, status="as read") for one in read)
        try:
            return standing_at(study, ShotPlaces(shots))
        except FieldError as error:
            listed = ", ".join(f"{one:g}" for one in read)
            raise ConfigError(f"{config.name}: shots at {listed} mm: {error}") from None

    def look(self) -> None:
        """The pictures or the scene, by the matrix of a calibration."""
        config, seen = self.config, self.taken.seen
        try:
            known = calibrated(Path(config.matrix or ""), self.folder.path)
            solvers = {method.name: method.build() for method in config.methods}
            shown = {name: levels / 255 for name, levels in config.shown.items()}
            asked = shown or {"scene": None}
            found = reconstruct_pictures(asked, seen.frames, known, solvers, seen.variance)
        except ValueError as error:
            raise ConfigError(f"{config.place_of('matrix')}matrix: {error}") from None
        self.folder.save_figure("images", plot.draw_pictures(found))
        for name, one in found.methods.items():
            for target, image in zip(found.targets, one.images, strict=True):
                self.folder.save_image(f"{slug(target)}--{slug(name)}", image)
        self.metrics["methods"] = {name: asdict(one.scores) for name, one in found.methods.items()}
        if shown:
            self.found = finding(found.methods)
            self.table = beside(found.methods, published_figures(config.targets))

    def align(self) -> None:
        """The place of the display, which `alignment` of a plan of pictures takes."""
        frames, config = self.taken.seen.frames, self.config
        study = build_study(config, (frames.shape[1], frames.shape[2]))
        display = self.taken.shown, config.display.pitch or 0.0
        found = align_display(study, frames, *display, config.plan.map)
        found.save(self.folder.path / "alignment.json")
        self.metrics["alignment"], self.found = found.summary(), str(found)

    def linearise(self) -> None:
        """The table of a display's grey levels, which its option of that name takes."""
        self.taken.calibration.save(self.folder.path / "grey_levels.json")
        self.metrics["grey_levels"] = dict(self.taken.calibration.provenance)

    def recover(self) -> None:
        """The matrix into a store, and what it is reduced to; compared where it is known."""
        taken, exact = self.taken, None
        captures = taken.calibration
        if taken.seen.camera is not None:
            system, light = screen_system(self.config)
            camera = replace(taken.seen.camera, light=light)
            exact = system, camera, taken.seen.pixels
        found = recover_to(self.folder.path, captures, exact)
        figure = draw_columns(self.config.camera.pitch, found.cells, found.columns)
        self.folder.save_figure("columns", figure)
        self.agreement = found.agreement
        self.metrics |= {
            "frames": captures.series.frame_count,
            "matrix": list(found.shape),
            "matrix_seconds": found.seconds,
        }


def build_study(config: CaptureConfig, shape: tuple[int, int]) -> Study:
    """The cameras of a lensless plan, for frames of a shape, with the method of each colour.

    **Errors**: ConfigError for a picture that cannot be read.
    """
    plan, optics, display = config.plan, config.optics, config.display
    assert optics is not None  # of lensless plans
    monitor = plan.kind in ("pictures", "alignment")  # the display is no mask
    other: Synthesis = "fringe_scanning" if plan.kind in ("fringe_scan", "method_a") else "separate"
    synthesis: Synthesis = "phase_pairs" if plan.kind == "method_b" else other
    phases = PHASES.get(synthesis, (plan.phase,))
    distances = plan.distances if plan.kind == "method_a" else (optics.distance,)
    betas, distances = np.broadcast_arrays(plan.betas or 0.0, distances)  # one of either
    width = plan.width if config.mask is None else config.mask.width
    assert width is not None
    solver = build_solver(config.reconstruction.kind, config.reconstruction.variation)
    methods = []
    for number, light in enumerate(optics.colours or (optics.wavelength,)):
        shots = Exposures(betas, distances, wavelength=light or 0.0, width=width)
        exposures = shots.at_phases(phases)
        if plan.mosaic is not None:
            exposures = exposures.at_once(plan.mosaic.build())
        methods.append(Method(f"{number}", exposures, solver, synthesis, len(phases)))

    def target(entry: PictureConfig) -> Target:
        """Target of a picture; in light of one wavelength colours are averaged."""
        seen, cells = optics.object, config.cells if monitor else None
        shown = picture(entry, cells, 3 if optics.colours else 0)
        return Target.of_image(entry.name, shown, seen.distance, seen.width, entry.kind)

    pixels = {"pixel_pitch": display.pitch, "fill_factor": display.fill_factor}
    given = {"width": plan.width, "profile": plan.profile} | ({} if monitor else pixels)
    mask = MaskConfig.model_construct(**given)
    sensor = SensorConfig.model_construct(shape=shape, pitch=config.camera.pitch)
    if display.phase_levels is None:
        built = build_optics(mask, sensor, methods[0].exposures[0])
    else:
        (levels,) = config.shown.values()
        seen = display.pitch, optics.wavelength, display.fill_factor
        built = display.phase_levels.build().mask(levels, *seen), sensor.build()
    return Study(
        *built,
        tuple(methods),
        tuple(config.read_all("targets", target)),
        object_distance=optics.object.distance,
        model=optics.model,
        pixel_integration=optics.pixel_integration,
        config=optics,
    )


def picture_levels(config: CaptureConfig) -> dict[str, np.ndarray]:
    """Levels, uint8, of the pictures that a matrix is for, by name: none of a real rig's scene.

    For a phase modulator those of its mask. **Errors**: ConfigError for what cannot be shown.
    """
    if config.mask is not None:
        table, light, pitch = config.display.phase_levels, config.optics, config.display.pitch
        assert table is not None and light is not None and light.wavelength is not None
        exposure = Exposure(0.0, 0.0, light.distance, light.wavelength, config.mask.width)
        try:
            shown = built_mask(config.mask, exposure), pitch, light.wavelength
            return {config.mask.label: table.build().levels_of(*shown)}
        except (ValueError, TypeError, OSError) as error:
            raise ConfigError(f"{config.place_of('mask')}mask: {error}") from None
    if config.cells is None or not (config.matrix or config.alignment):
        return {}

    known = None if config.alignment is None else _alignment(config)

    def levels(one: PictureConfig) -> tuple[str, np.ndarray]:
        found = np.rint(255 * picture(one, config.cells)).astype(np.uint8)
        if known is not None and config.optics is not None:
            found = known.place(found, config.optics.object.width)
        return one.name, found

    return dict(config.read_all("targets", levels, "path"))


def _alignment(config: CaptureConfig) -> Alignment:
    """The place of the display. **Errors**: ConfigError, one line, where there is none."""
    try:
        return Alignment.load(config.alignment or "")
    except OSError as error:
        fault = f"{config.alignment}: {error.strerror}; capture and run a plan of kind alignment"
    except ValueError as error:
        fault = str(error)
    raise ConfigError(f"{config.place_of('alignment')}alignment: {fault}")


def screen_system(config: CaptureConfig) -> tuple[Sparse, Any]:
    """Matrix from a virtual rig's cells to its sensor: 1 where a white monitor is brightest.

    And the light (y, x) of a display behind the plate in this unit, 0 without.
    """
    from thincam_jax.waveguide.commands.run import build_cameras, build_display, build_plane
    from thincam_jax.waveguide.system import monitor_system

    assert config.virtual is not None and config.virtual.screen is not None
    seen = config.virtual.screen
    plane, (camera,) = build_plane(seen), build_cameras(seen)
    try:
        display = build_display(seen)
        system, level = monitor_system(camera, plane, seen.orders, seen.band_samples)
        light = 0.0 if display is None else display.irradiance(camera.sensor.shape, level)
        return system, light
    except ValueError as error:
        place = "virtual", "screen", *getattr(error, "place", ())
        raise ConfigError(f"{config.place_of(*place)}{'.'.join(place)}: {error}") from None
