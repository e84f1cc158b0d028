"""The command `thincam capture`, and the devices of the files that it takes."""

import contextlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thincam_jax.commands.terminal import (
    ConfigFile,
    DryRun,
    Overrides,
    progress_bar,
    say,
    tell,
    told,
    warn,
)

if TYPE_CHECKING:
    from thincam_jax.commands.capture.config import CaptureConfig

STOPPED = 3  # exit code of an acquisition that a device stopped, and that can go on
_CONFIG, _SECONDS = "config.yaml", "seconds.json"


def capture(
    config: ConfigFile,
    out: Annotated[
        Path | None, typer.Option(help="Store of the frames; default runs/NAME.zarr.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a store that is not complete.")
    ] = False,
    set_: Overrides = None,
    dry_run: DryRun = False,
) -> None:
    """Take the frames of a plan with the devices of a rig, real or virtual.

    Each frame is on the disk before it counts as taken: after Ctrl-C, an error of a device or a
    power cut, --resume goes on. 'thincam run STORE' makes the image or the matrix of them.
    """
    store = out or Path()
    kept = ""

    def go_on() -> str:
        typed = "".join(f" --set '{text}'" for text in set_ or ())
        return f"{kept}; go on with: thincam capture {config} --out {store} --resume{typed}"

    with told(lambda: f"interrupted; {go_on()}" if kept else "interrupted; nothing was taken."):
        from thincam_jax._core.files import MeasurementError, write_whole
        from thincam_jax.commands import explain
        from thincam_jax.commands.checked_config import dump_config
        from thincam_jax.commands.config_file import ConfigError, slug
        from thincam_jax.commands.kinds import load_experiment
        from thincam_jax.commands.run_folder import to_json
        from thincam_jax.hardware.acquisition.acquire import acquire
        from thincam_jax.hardware.errors import HardwareError

        asked = load_experiment(config, tuple(set_ or ()), "capture")
        store = out or Path("runs") / f"{slug(asked.name)}.zarr"
        if store.exists() and not resume:
            raise ConfigError(f"--out {store} exists; --resume goes on with it, else give another")
        if resume and not store.exists():
            raise ConfigError(f"--out {store}: there is nothing to resume; leave out --resume")
        plan = build_plan(asked)
        if dry_run:
            explain.dry_run(asked, f"writes to {store}: {len(plan.steps)} frames", plan)
            return
        kept = f"0 of {len(plan.steps)} frames are kept"
        procedure = asked.acquisition.build(settle=asked.display.settle)
        try:
            store.parent.mkdir(parents=True, exist_ok=True)
            with opened(asked) as rig, progress_bar("{task.fields[rate]}") as bar:
                task = bar.add_task(asked.name, total=len(plan.steps), rate="")

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
        except MeasurementError as error:
            raise ConfigError(str(error)) from None
        write_whole(store / _CONFIG, dump_config(asked))
        write_whole(store / _SECONDS, to_json(outcome.seconds))
        warn([f"recovered from {text}" for text in outcome.recovered])
        if not outcome.complete:
            raise KeyboardInterrupt
    say(f"{store}: {outcome.total} frames; next: thincam run {store}")


def reconstruct_store(store: Path, out: Path | None) -> Path:
    """What `thincam run` does with a store; returns the folder of the report.

    **Errors**: ConfigError, one line, for a folder that is no complete store.
    """
    from thincam_jax._core.files import MeasurementError
    from thincam_jax.commands.capture.config import CaptureConfig
    from thincam_jax.commands.capture.run import run_captures
    from thincam_jax.commands.checked_config import load_as
    from thincam_jax.commands.config_file import ConfigError, slug
    from thincam_jax.commands.run_folder import RunFolder
    from thincam_jax.commands.terminal import counted

    if not (store / _CONFIG).is_file():
        raise ConfigError(
            f"{store} is a folder; give the path of an experiment file, or a store that thincam "
            "capture has completed"
        )
    config = load_as(CaptureConfig, store / _CONFIG)
    folder = RunFolder(out or Path("runs") / slug(config.name))
    try:
        taken = _taken(store, config)
        with counted(config.name) as progress:
            run_captures(config, taken, folder, progress)
    except MeasurementError as error:
        raise ConfigError(str(error)) from None
    return folder.path


def draw(pattern: Any, shape: tuple[int, int], pitch: float) -> Any:
    """Levels (y, x) of a plan's pattern on a display of a shape and a pixel pitch, mm.

    **Errors**: ConfigError for a mask that the display's pixels cannot show.
    """
    import numpy as np

    from thincam_jax.commands.config_file import ConfigError
    from thincam_jax.hardware.displays.patterns import hadamard_frame, mask_pattern
    from thincam_jax.lensless.masks.fza import FresnelZoneAperture
    from thincam_jax.measured.calibration.hadamard import HadamardSeries

    numbers = dict(pattern.numbers)
    if pattern.kind == "black":
        return np.zeros(shape, np.uint8)
    if pattern.kind == "hadamard":
        cells, frame = (numbers.pop("rows"), numbers.pop("columns")), numbers.pop("frame")
        return hadamard_frame(HadamardSeries(cells, **numbers), frame, shape)
    try:
        return mask_pattern(FresnelZoneAperture(**numbers, pixel_pitch=pitch), shape, pitch)
    except ValueError as error:
        raise ConfigError(f"plan.width: {error}") from None


def known_drivers() -> list[str]:
    """A line for each driver: its kind and name, its package, and why it cannot be used."""
    from thincam_jax.hardware.errors import NotFound
    from thincam_jax.hardware.registry import KINDS, driver, drivers

    lines = []
    for kind in KINDS:
        for name, place in drivers(kind).items():
            package = place.partition(".")[0].partition(":")[0]
            line = f"driver of {kind} {name}"
            if package != "thincam_jax":
                line = f"{line}, from {package}"
            try:
                driver(kind, name)
            except NotFound as error:
                line = f"{line}: {error.cause}; {error.remedy}"
            lines.append(line)
    return lines


def build_plan(config: "CaptureConfig") -> Any:
    """The plan of a file, with its settings."""
    from dataclasses import replace

    from thincam_jax.hardware.acquisition import plan as plans
    from thincam_jax.hardware.base import CameraSettings

    asked, camera, optics = config.plan, config.camera, config.optics
    settings = camera.build(CameraSettings)
    if asked.kind == "hadamard":
        return plans.hadamard(asked.series, settings)
    assert optics is not None and asked.width is not None  # of lensless plans
    mask = plans.zone_plate(asked.betas[0], asked.width, phase=asked.phase, profile=asked.profile)

    def planned(dark_every: int) -> Any:
        zero = {"stage_zero": optics.distance, "dark_every": dark_every}
        if asked.kind == "method_a":
            return plans.method_a(mask, asked.distances, settings, **zero)
        if asked.kind == "psf_stack":
            return plans.psf_stack(mask, asked.distances, settings, **zero)
        if asked.kind == "method_b":
            return plans.method_b(mask, asked.betas, settings, dark_every=dark_every)
        return plans.fringe_scan(mask, settings, dark_every=dark_every)

    shots = len(planned(0).steps)
    plan = planned(-(-shots // asked.dark_frames) if asked.dark_frames else 0)
    if config.stage is not None:  # it stands where the optics are known
        steps = [s if s.position is not None else replace(s, position=0.0) for s in plan.steps]
        plan = replace(plan, steps=tuple(steps))
    return plan


@contextlib.contextmanager
def opened(config: "CaptureConfig") -> Iterator[Any]:
    """The rig of a file with its devices open, its stage homed."""
    from thincam_jax.commands.config_file import ConfigError
    from thincam_jax.hardware.acquisition.rig import Rig
    from thincam_jax.hardware.registry import open_device
    from thincam_jax.hardware.virtual.devices import VirtualDevices

    with contextlib.ExitStack() as stack:
        camera: Callable[[], Any]
        display: Callable[[], Any]
        stage: Callable[[], Any] | None = None
        if config.rig == "virtual":
            devices = stack.enter_context(VirtualDevices(virtual_rig(config)))
            camera = partial(devices.camera, config.camera.driver, config.camera.options)
            display = devices.display
            if config.stage is not None:
                stage = partial(devices.stage, config.stage.driver, config.stage.options)
        else:

            def opener(kind: str, device: Any) -> Callable[[], Any]:
                return partial(open_device, kind, device.driver, device.options)

            camera, display = opener("cameras", config.camera), opener("displays", config.display)
            if config.stage is not None:
                stage = opener("stages", config.stage)
        rigs: list[Any] = []

        def render(pattern: Any) -> Any:
            return draw(pattern, rigs[0].display.shape, config.display.pitch)

        try:
            rigs.append(stack.enter_context(Rig(camera, display, render, stage)))
        except (ValueError, TypeError) as error:  # of a driver's options
            raise ConfigError(f"options: {error}") from None
        if rigs[0].stage is not None and not rigs[0].stage.homed:
            rigs[0].stage.home()
        yield rigs[0]


def virtual_rig(config: "CaptureConfig") -> Any:
    """The state and the optics that the virtual devices of a file share."""
    from thincam_jax.commands.capture.run import build_study, screen_system
    from thincam_jax.hardware.virtual.optics import ModulatorOptics, MonitorOptics
    from thincam_jax.hardware.virtual.rig import Electronics, VirtualRig
    from thincam_jax.imaging.scene import Scene
    from thincam_jax.imaging.sensor import Sensor

    virtual, display, optics = config.virtual, config.display, config.optics
    assert virtual is not None  # checked with the file
    if optics is None:
        seen = MonitorOptics(screen_system(config), virtual.electrons)
    else:
        plane = build_study(config, virtual.sensor).targets[0].plane
        seen = ModulatorOptics(
            Scene(plane, optics.wavelength),
            Sensor(virtual.sensor, config.camera.pitch),
            display.pitch,
            optics.distance,
            virtual.electrons,
            display.fill_factor,
        )
    return VirtualRig(
        seen,
        virtual.build(Electronics),
        display_shape=virtual.display,
        response=virtual.response or 0.0,
        fiducial=virtual.fiducial,
        seed=config.seed,
    )


def _taken(store: Path, config: "CaptureConfig") -> Any:
    """What a store holds, and how it is to be compared."""
    import json

    from thincam_jax._core.files import read_regular
    from thincam_jax.commands.capture.run import Taken
    from thincam_jax.hardware.acquisition.read import read_acquisition
    from thincam_jax.hardware.virtual.rig import Electronics
    from thincam_jax.studies.rig import CountingCamera

    found = read_acquisition(store)
    hadamard = None
    lit = found.lit
    if config.plan.kind == "hadamard":
        import numpy as np

        from thincam_jax.measured.calibration import open_captures

        hadamard = open_captures(store)
        lit = lit[:8]
        frames = np.stack([found.frame(step) for step in lit]).astype(np.float32)
    else:
        frames = found.captures()
    patterns = [found.plan.pattern(found.plan.steps[step]) for step in lit]
    display = config.virtual.display if config.virtual is not None else (768, 1024)
    darks = sum(step.dark for step in found.plan.steps)
    simulated = None
    if config.rig == "virtual" and config.virtual is not None:
        virtual = config.virtual
        electronics = virtual.build(Electronics)
        electron, offset = electronics.scale(found.settings[0])
        counts = electron * found.settings[0].exposure * virtual.electrons
        simulated = CountingCamera(counts, electron, virtual.read_noise, 0.0 if darks else offset)
    region = found.settings[0].region
    rows, columns = found.sensor_shape
    top, left = (0, 0) if region is None else (region.top, region.left)
    pixels = slice(top, top + rows), slice(left, left + columns)
    seconds = store / _SECONDS
    return Taken(
        frames,
        [_label(pattern) for pattern in patterns],
        [draw(pattern, display, config.display.pitch) for pattern in patterns],
        pixels,
        json.loads(read_regular(seconds)) if seconds.is_file() else {},
        simulated,
        darks,
        hadamard,
    )


def _label(pattern: Any) -> str:
    if pattern.kind == "fza":
        return f"β {pattern.numbers['beta']:.3g} rad/mm², φ {pattern.numbers['phase']:.2f}"
    if pattern.kind == "hadamard":
        return f"pattern {pattern.numbers['frame']}"
    return pattern.kind
