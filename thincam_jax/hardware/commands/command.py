"""The command `thincam capture`, and the devices of the files that it takes."""

import contextlib
import itertools
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thincam_jax.commands.run import Browser, Port, serve_page
from thincam_jax.commands.terminal import (
    ConfigFile,
    DryRun,
    Overrides,
    progress_bar,
    reported,
    say_result,
    tell,
    warn,
)

if TYPE_CHECKING:
    import rich.progress

    from thincam_jax.hardware.acquisition.plan import AcquisitionPlan, Pattern
    from thincam_jax.hardware.acquisition.rig import Rig
    from thincam_jax.hardware.commands.config import CaptureConfig
    from thincam_jax.hardware.commands.run import Taken
    from thincam_jax.hardware.virtual.rig import VirtualRig

STOPPED = 3  # exit code of an acquisition that a device stopped, and that can go on
_CONFIG, _SECONDS = "config.yaml", "seconds.json"


def capture(
    config: ConfigFile,
    out: Annotated[
        Path | None, typer.Option(help="Store for the frames. Default: runs/NAME.zarr.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue an incomplete store.")] = False,
    set_: Overrides = None,
    dry_run: DryRun = False,
) -> None:
    """Take the frames of a plan with a rig.

    The devices are real or virtual. Each frame is on the disk before it counts as taken: after
    Ctrl-C, an error of a device or a power cut, --resume goes on. 'thincam run STORE' makes the
    image or the matrix of them.
    """
    store = out or Path()
    kept = ""

    def go_on() -> str:
        typed = "".join(f" --set '{text}'" for text in set_ or ())
        return f"{kept}; go on with: thincam capture {config} --out {store} --resume{typed}"

    with reported(lambda: f"interrupted; {go_on()}" if kept else "interrupted; nothing was taken."):
        from thincam_jax._core.files import write_whole
        from thincam_jax._core.text import slug
        from thincam_jax.commands import run
        from thincam_jax.commands.checked_config import dump_config
        from thincam_jax.commands.config_file import ConfigError
        from thincam_jax.commands.kinds import load_experiment
        from thincam_jax.commands.run_folder import to_json
        from thincam_jax.hardware.acquisition.acquire import acquire
        from thincam_jax.hardware.base import HardwareError

        asked = load_experiment(config, tuple(set_ or ()), "capture")
        store = out or Path("runs") / f"{slug(asked.name)}.zarr"
        if store.exists() and not resume:
            raise ConfigError(f"--out {store} exists; --resume goes on with it, else give another")
        plan = build_plan(asked)
        if dry_run:
            run.explain_run(asked, f"writes to {store}: {len(plan.steps)} frames", plan)
            return
        kept = f"0 of {len(plan.steps)} frames are kept"
        procedure = asked.acquisition.build(settle=asked.display.settle)
        try:
            store.parent.mkdir(parents=True, exist_ok=True)
            with opened(asked, plan) as rig, progress_bar("{task.fields[rate]}") as bar:
                task = bar.add_task(asked.name, total=len(plan.steps), rate="")
                if rig.stage is not None and rig.stage.by_hand:
                    rig.on_step = _pausing(bar, plan, rig.on_step)

                def told_of(made: Any) -> None:
                    nonlocal kept
                    kept = f"{made.done} of {made.total} frames are kept"
                    rate = f"{made.rate:.1f} frames/s"
                    bar.update(task, completed=made.done, rate=rate)
                    bar.start()

                outcome = acquire(plan, rig, store, procedure=procedure, progress=told_of)
        except HardwareError as error:
            tell(str(error))
            if store.exists():
                tell(go_on())
            raise typer.Exit(STOPPED) from None
        write_whole(store / _CONFIG, dump_config(asked))
        write_whole(store / _SECONDS, to_json(outcome.seconds))
        warn([f"recovered from {text}" for text in outcome.recovered])
        if not outcome.complete:
            raise KeyboardInterrupt
    made = "; ".join((f"{outcome.total} frames", *outcome.found))
    say_result("store", store, f"{store}: {made}; next: thincam run {store}")


def _pausing(
    bar: "rich.progress.Progress", plan: "AcquisitionPlan", on_step: Callable[[int], None]
) -> Callable[[int], None]:
    """`on_step` that takes the bar away before a step that asks someone to move the stage."""
    places = [step.position for step in plan.placed()]

    def paused(number: int) -> None:
        if bar.live.is_started and places[number] != places[number - 1]:
            bar.stop()
        on_step(number)

    return paused


def preview(
    config: ConfigFile, set_: Overrides = None, port: Port = 0, browser: Browser = True
) -> None:
    """Show what the camera of a rig sees.

    Opens a page in the browser to align, focus and expose. Turn exposure, gain, the pattern and the
    stage; k keeps a frame in frames/. Ctrl-C ends it.
    """
    with reported(lambda: "interrupted"):
        from thincam_jax.commands.kinds import load_experiment
        from thincam_jax.hardware.base import HardwareError
        from thincam_jax.hardware.commands.run import build_study
        from thincam_jax.hardware.preview import Preview
        from thincam_jax.hardware.studies.images import live_image

        asked = load_experiment(config, tuple(set_ or ()), "capture")
        plan = build_plan(asked)
        try:
            with opened(asked, plan) as rig:
                image, region = None, asked.camera.region
                if asked.optics is not None:
                    shape = (region.height, region.width) if region else rig.camera.sensor_shape
                    seen = build_study(asked, shape), asked.optics.object.width
                    image = live_image(*seen, plan.settings[0].bayer)
                procedure = asked.acquisition.build(settle=asked.display.settle)
                serve_page(Preview(rig, plan, procedure, image=image), asked.name, port, browser)
        except HardwareError as error:
            tell(str(error))
            raise typer.Exit(STOPPED) from None


def reconstruct_store(store: Path, out: Path | None) -> Path:
    """Reconstruct a store of captures; returns the folder of the report.

    **Errors**: ConfigError or MeasurementError, one line, for a folder that is no complete store.
    """
    from thincam_jax._core.text import slug
    from thincam_jax.commands.checked_config import load_as
    from thincam_jax.commands.config_file import ConfigError
    from thincam_jax.commands.run_folder import RunFolder
    from thincam_jax.commands.terminal import counted
    from thincam_jax.hardware.commands.config import CaptureConfig
    from thincam_jax.hardware.commands.run import run_captures

    if not (store / _CONFIG).is_file():
        raise ConfigError(
            f"{store} is a folder; give the path of an experiment file, or a store that thincam "
            "capture has completed"
        )
    config = load_as(CaptureConfig, store / _CONFIG)
    folder = RunFolder(out or Path("runs") / slug(config.name))
    taken = _taken(store, config)
    with counted(config.name) as progress:
        run_captures(config, taken, folder, progress)
    return folder.path


def known_drivers(connected: bool = False, asked: str | None = None) -> list[str]:
    """A line for each driver; each device that is there; what answers at a serial port."""
    from thincam_jax.commands.config_file import ConfigError
    from thincam_jax.hardware import registry
    from thincam_jax.hardware.base import HardwareError

    try:
        there = registry.report(asked) if connected or asked else []
    except HardwareError as error:
        raise ConfigError(str(error)) from None
    return registry.driver_report() + there


def build_plan(config: "CaptureConfig") -> "AcquisitionPlan":
    """The plan of a file, with its settings."""
    from thincam_jax.hardware.base import CameraSettings
    from thincam_jax.hardware.plans import levels_pattern

    settings, shown = config.camera.build(CameraSettings), config.shown
    given = {"stage_zero": 0.0 if config.optics is None else config.optics.distance, "shown": shown}
    if config.mask is not None:
        ((name, levels),) = shown.items()
        given |= {"shown": {}, "mask": levels_pattern(name, levels)}
    plan = config.plan.build().plan(settings, **given)
    if config.stage is not None:  # it stands where the optics are known
        plan = plan.at_position(0.0)
    return plan


@contextlib.contextmanager
def opened(config: "CaptureConfig", plan: "AcquisitionPlan") -> Iterator["Rig"]:
    """The rig of a file with its devices open, its stage homed.

    **Errors**: ConfigError for options of a driver, and for what the display cannot show.
    """
    from thincam_jax.commands.config_file import ConfigError
    from thincam_jax.hardware.acquisition.rig import open_rig

    pitch, virtual, pictures = config.display.pitch or 0.0, None, config.shown
    if config.rig == "virtual":
        virtual = virtual_rig(config)
    with contextlib.ExitStack() as stack:
        try:
            given = {"turns_phase": config.mask is not None, "pictures": pictures}
            rig = stack.enter_context(open_rig(config.drivers, pitch, virtual=virtual, **given))
        except (ValueError, TypeError) as error:
            raise ConfigError(f"options: {error}") from None
        _shown(rig.render, plan.patterns[0])
        yield rig


def _shown(render: Callable[["Pattern"], Any], pattern: "Pattern") -> Any:
    """Levels (y, x) on a display. **Errors**: ConfigError for a pattern that it cannot show."""
    from thincam_jax.commands.config_file import ConfigError

    try:
        return render(pattern)
    except ValueError as error:
        keys = {"fza": "plan.width", "mark": "plan.spread", "pixels": "mask"}
        raise ConfigError(f"{keys.get(pattern.kind, 'plan.cells')}: {error}") from None


def virtual_rig(config: "CaptureConfig") -> "VirtualRig":
    """The state and the optics that the virtual devices of a file share."""
    from thincam_jax.hardware.base import CameraSettings
    from thincam_jax.hardware.commands.run import build_study, screen_system
    from thincam_jax.hardware.studies.images import mosaic_of
    from thincam_jax.hardware.studies.rig import lensless_system, scenes_of
    from thincam_jax.hardware.virtual.optics import (
        ModulatorOptics,
        MonitorOptics,
        MosaicOptics,
        StageErrors,
        WalledOptics,
    )
    from thincam_jax.hardware.virtual.rig import Electronics, VirtualRig

    virtual, display, optics = config.virtual, config.display, config.optics
    assert virtual is not None  # checked with the file
    if optics is None:
        before = next(iter(config.shown.values())) if config.plan.kind == "scene" else None
        system, light = screen_system(config)
        seen = MonitorOptics(system, virtual.electrons, before, background=light)
    elif config.plan.kind in ("pictures", "alignment"):
        cell = -config.camera.pitch * optics.object.distance / optics.distance  # turned by 180°
        place = virtual.monitor.build().homography(optics.object.distance, display.pitch, cell)
        system = lensless_system(build_study(config, virtual.sensor), optics.object.width)
        seen = MonitorOptics(system, virtual.electrons, place=place)
    else:
        study = build_study(config, virtual.sensor)
        light: Any = display.pitch, optics.distance, virtual.electrons, display.fill_factor
        if display.phase_levels is not None:
            pixels: Any = study.mask
            table = virtual.phase_levels or display.phase_levels
            light += table.build(), pixels.amplitude.shape
        errors = StageErrors() if virtual.stage is None else virtual.stage.build()
        parts = [
            ModulatorOptics(one, study.sensor, *light, stage=errors) for one in scenes_of(study)
        ]
        side_by_side = mosaic_of(study)
        if side_by_side is not None and side_by_side.wall is not None:
            parts = [WalledOptics(one, side_by_side) for one in parts]
        pattern = config.camera.build(CameraSettings, region=None).bayer
        seen = parts[0] if pattern is None else MosaicOptics(parts, pattern)
    given = {"electronics": virtual.build(Electronics), "display_shape": virtual.display}
    return virtual.build(VirtualRig, optics=seen, seed=config.seed, **given)


def _taken(store: Path, config: "CaptureConfig") -> "Taken":
    """Read the captured frames of a store."""

    import numpy as np

    from thincam_jax._core.files import read_json
    from thincam_jax.hardware.acquisition.read import Acquisition
    from thincam_jax.hardware.commands.run import SHOWN_PAIRS, Taken
    from thincam_jax.hardware.displays.levels import measured_levels
    from thincam_jax.hardware.displays.patterns import pattern_levels
    from thincam_jax.hardware.studies.rig import CountingCamera, RigFrames
    from thincam_jax.hardware.virtual.rig import FIDUCIAL_SHAPE, Electronics
    from thincam_jax.measured.calibration import HadamardCaptures

    found, kind = Acquisition.load(store), config.plan.kind
    camera, variance, calibration = None, None, None
    if kind in ("hadamard", "grey_levels"):
        calibration = HadamardCaptures.load(store) if kind == "hadamard" else measured_levels(found)
        frames = np.stack([found.frame(step) for step in found.lit[:8]]).astype(np.float32)
    elif config.makes_pairs:
        frames = np.stack([mean for _, mean in itertools.islice(found.means(), SHOWN_PAIRS)])
        calibration = found
    elif kind == "scene" or config.alignment:
        frames, variance = found.scene()
    else:
        frames = found.captures()
    patterns, virtual = found.patterns[: len(frames)], config.virtual
    darks = sum(step.dark for step in found.plan.steps)
    known = kind != "scene" or variance is not None or config.plan.frames == 1
    lit = np.ones(frames.shape[1:], bool)
    if config.rig == "virtual" and virtual is not None and known:
        lit[: FIDUCIAL_SHAPE[0], : FIDUCIAL_SHAPE[1]] = not virtual.fiducial
        electron, offset = virtual.build(Electronics).scale(found.settings[0])
        counts = electron * found.settings[0].exposure * virtual.electrons
        camera = CountingCamera(counts, electron, virtual.read_noise, 0.0 if darks else offset)
    display = found.provenance.get("display_shape") or (virtual and virtual.display) or (768, 1024)
    given = {"pitch": config.display.pitch, "pictures": config.shown}
    render = partial(pattern_levels, shape=tuple(display), **given)
    seconds, places = store / _SECONDS, [found.shots[step]["position"] for step in found.lit]
    return Taken(
        RigFrames(
            *(frames, camera, found.pixels, lit, darks, variance, found.settings[0].bayer),
            positions=tuple(place for place in places if place is not None),
        ),
        [pattern.label for pattern in patterns],
        [_shown(render, pattern) for pattern in patterns if config.display.pitch],
        [one.exposure for one in found.settings],
        read_json(seconds) if seconds.is_file() else {},
        calibration,
    )


def frames(asked: Any, setup: Any) -> Iterator[str]:
    """Frames of a capture, and the time that they are exposed."""
    plan = build_plan(asked) if setup is None else setup
    seconds = sum(plan.settings[step.settings].exposure for step in plan.steps)
    yield f"{len(plan.steps)} frames, exposed for {seconds:.3g} s in all"


COMMANDS = (
    (preview, "preview rig_virtual.yaml"),
    (capture, "capture rig_virtual.yaml", "capture rig.yaml --out frames.zarr --resume"),
)
