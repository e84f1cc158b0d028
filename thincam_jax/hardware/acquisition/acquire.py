"""Acquisition of a plan's frames into a store, with recovery from errors.

A permanent error stops the run, as do Ctrl-C, SIGTERM, SIGKILL and a power cut. The same call
resumes it, with the same plan, devices and settings.
"""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from thincam_jax._core.capture_store import (
    CALIBRATION,
    CAPTURES,
    TOGETHER,
    CaptureStore,
    CaptureStoreError,
    dtype_of_bits,
)
from thincam_jax._core.text import of_error, shortened
from thincam_jax.hardware.acquisition.plan import BLACK, AcquisitionPlan, settings_from
from thincam_jax.hardware.acquisition.recorder import (
    Recorder,
    create_store,
    locked,
    now,
    require_space,
    versions,
)
from thincam_jax.hardware.acquisition.rig import Rig
from thincam_jax.hardware.acquisition.taker import (
    QUANTILE,
    Procedure,
    Taker,
    find_exposure,
    full_scale,
)
from thincam_jax.hardware.base import CameraSettings, Identity, NotHomed, OutOfRange
from thincam_jax.hardware.displays.settle import LONGEST, Shutter, settle_calibrate


@dataclass(frozen=True)
class AcquisitionProgress:
    """State after each frame: frames taken and in all, and frames per second."""

    done: int
    total: int
    rate: float


@dataclass(frozen=True)
class AcquisitionOutcome:
    """End of a run.

    - `done`, `total`: frames in the store, and of the plan.
    - `found`: settings measured before the first frame: exposure, settle time.
    - `recovered`: the errors that a retry resolved, one line each.
    - `seconds`: spent on "move", "show", "settle", "flush", "trigger", "check", "keep".
    """

    path: Path
    done: int
    total: int
    found: tuple[str, ...] = ()
    recovered: tuple[str, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        """Whether all frames are there; else the run was stopped and can be resumed."""
        return self.done == self.total


def acquire(
    plan: AcquisitionPlan,
    rig: Rig,
    path: str | Path,
    *,
    procedure: Procedure | None = None,
    progress: Callable[[AcquisitionProgress], None] | None = None,
) -> AcquisitionOutcome:
    """Take the frames of a plan into the store at `path`, or those that it lacks.

    Ctrl-C and SIGTERM stop after the present frame, a second Ctrl-C at once. Frames taken are kept,
    also after an error, and the same call resumes.

    **Errors**: CaptureStoreError, one line, where the store is of another plan, device or setting,
    is being written by another run, or does not fit on the disk; the HardwareError that retries did
    not resolve, or that is not retried: OutOfRange, NotHomed, Saturated and others.
    """
    path, procedure = Path(path).absolute(), procedure or Procedure()
    with _stop_requested() as stop, locked(path):
        run = Taker(plan, rig, procedure)
        settings = _begin(run, path)
        with Recorder(path) as recorder:
            todo, total = recorder.missing, len(run.steps)
            require_space(path, len(todo) * recorder.store.frame_bytes)
            recorder.note(
                {"begins": now(), "versions": versions(), "procedure": asdict(run.procedure)}
            )
            if rig.stage is not None:
                rig.stage.recall(_readings(run, recorder))
            done, started = total - len(todo), time.monotonic()
            for count, number in enumerate(todo, 1):
                if stop.is_set():
                    break
                step = run.steps[number]
                rig.on_step(number)
                frame, facts = run.take(step, settings[step.settings])
                with run.clock("keep"):
                    recorder.add(number, frame.pixels, facts)
                done += 1
                if progress is not None:
                    rate = count / max(time.monotonic() - started, 1e-9)
                    progress(AcquisitionProgress(done, total, rate))
    found = []
    if procedure.exposure == "auto":
        found.append(f"exposure {1000 * settings[0].exposure:.4g} ms")
    if procedure.settle is None:
        found.append(f"settle time {1000 * (run.procedure.settle or 0.0):.3g} ms")
    return AcquisitionOutcome(path, done, total, tuple(found), tuple(run.recovered), run.seconds)


def _begin(run: Taker, path: Path) -> tuple[CameraSettings, ...]:
    """Create the store, or check that it belongs to this run; returns its camera settings."""
    if positions := [step.position for step in run.steps if step.position is not None]:
        _require_stage(run, positions)
    if path.exists():
        return _resumed(run, path)
    settings = _measured(run)
    shape, *others = {run.shape(one) for one in settings}
    if others:
        raise ValueError(
            f"the plan {run.plan.name!r} has regions of several sizes; give one size, or a plan "
            "for each"
        )
    first = run.steps[0]
    frame, facts = run.take(first, settings[first.settings], probe=True)
    run.bits = bits = frame.bit_depth
    shown_on = run.rig.display.shape
    attributes = {
        "kind": CAPTURES,
        "sensor_shape": shape,
        "bits": bits,
        "acquisition": {
            "plan": run.plan.hash,
            "name": run.plan.name,
            "devices": {role: asdict(device) for role, device in run.identities.items()},
            "settings": [asdict(one) for one in settings],
            "asked": [asdict(one) for one in run.plan.settings],
            "procedure": asdict(run.procedure),
            "start": facts["position"],
            "display_shape": () if shown_on == Shutter.shape else shown_on,
            "versions": versions(),
            "begun": now(),
        },
    }
    together = 1
    if series := run.plan.facts.get("series"):
        attributes |= {"kind": CALIBRATION, "exposure": settings[0].exposure}
        # The store of a series counts the dark frames last.
        order = sorted(range(len(run.plan.steps)), key=lambda n: run.plan.steps[n].dark)
        attributes |= {"stored_at": order, **series}
        together = TOGETHER
    whole = (len(run.plan.steps), *shape)
    layout = whole, dtype_of_bits(bits), attributes
    create_store(path, run.plan.as_json(), *layout, together=together)
    return settings


def _readings(run: Taker, recorder: Recorder) -> dict[float, float]:
    """Positions that the stage reached for the frames taken, by those asked for, mm."""
    places = {run.steps[step].position: one["position"] for step, one in recorder.taken.items()}
    return {asked: float(found) for asked, found in places.items() if asked is not None}


def _require_stage(run: Taker, positions: list[float]) -> None:
    """Check that a homed stage can take all positions of a plan, mm."""
    stage = run.rig.stage
    if stage is None:
        raise ValueError(
            f"the plan {run.plan.name!r} moves a stage and the rig has none; give open_stage"
        )
    if not stage.homed:
        raise NotHomed(run.name("stage"), "begin", "it does not know where it is", "home it first")
    low, high = stage.limits
    if outside := [place for place in positions if not low <= place <= high]:
        cause = f"{len(outside)} steps of the plan lie outside, the first at {outside[0]:g} mm"
        remedy = f"give positions from {low:g} to {high:g} mm"
        raise OutOfRange(run.name("stage"), "begin", cause, remedy)


def _resumed(run: Taker, path: Path) -> tuple[CameraSettings, ...]:
    """Camera settings with which the store was begun, after checking that all else agrees."""
    store = CaptureStore(path)
    try:
        begun = store.attributes["acquisition"]
        name, plan, start = str(begun["name"]), str(begun["plan"]), begun.get("start")
        devices = {role: Identity(**record) for role, record in begun["devices"].items()}
        settings = tuple(settings_from(record) for record in begun["settings"])
        if run.procedure.settle is None:
            settle = begun["procedure"]["settle"]
            run.procedure = replace(run.procedure, settle=settle)
        run.steps = run.plan.placed(None if start is None else float(start))
    except Exception as error:  # whatever another's attributes bring about
        raise CaptureStoreError(
            f"{path} was not made by an acquisition ({of_error(error)}); give another name"
        ) from error
    if plan != run.plan.hash or len(store.digests) != len(run.steps):
        raise CaptureStoreError(
            f"{path} was begun with another plan ({shortened(name)}, {plan[:12]}), not "
            f"with this one ({run.plan.name}, {run.plan.hash[:12]}); give another name, or "
            "the plan it was begun with"
        )
    for role in sorted({*devices, *run.identities}):
        was, now_is = (every.get(role, "none") for every in (devices, run.identities))
        if was != now_is:
            raise CaptureStoreError(
                f"{path} was begun with the {role} {was}, and this rig has {now_is}; connect that "
                "one, or give another name"
            )
    for one in settings:
        run.persist(lambda one=one: run.configure(one))
    run.bits = store.attributes["bits"]
    if isinstance(run.rig.display, Shutter) and any(step.dark for step in run.steps):
        run.rig.display.forget()
    return settings


def _measured(run: Taker) -> tuple[CameraSettings, ...]:
    """Camera settings nearest to the plan's; exposure and settle time measured if wanted."""
    asked, wanted = run.plan.settings, run.procedure
    unknown = wanted.settle is None and run.rig.display.shape != Shutter.shape
    measured = unknown and not isinstance(run.rig.display, Shutter)
    if unknown:
        run.procedure = replace(wanted, settle=LONGEST)
    lit = next((s for s in run.steps if not s.dark), run.steps[0])
    if wanted.exposure == "auto":

        def level_at(exposure: float) -> float:
            settings = run.persist(lambda: run.set_near(replace(asked[0], exposure=exposure)))
            frame, _ = run.take(lit, settings, probe=True)
            level = np.quantile(frame.pixels, QUANTILE)
            return float(level) / full_scale(frame)

        start = asked[0].exposure
        ratio = find_exposure(level_at, start, run.name("camera")) / start
        asked = tuple(replace(one, exposure=ratio * one.exposure) for one in asked)
    settings = tuple(run.persist(lambda one=one: run.set_near(one)) for one in asked)
    if measured:
        run.persist(lambda: run.configure(settings[0]))
        patterns = run.rig.render(BLACK), run.rig.render(run.plan.pattern(lit))
        given = {"longest": LONGEST, "timeout": wanted.timeout}
        settle = settle_calibrate(run.rig.display, run.rig.camera, patterns, **given)
        run.forget()
        run.procedure = replace(wanted, settle=settle)
    return settings


@contextmanager
def _stop_requested() -> Iterator[threading.Event]:
    """Event that Ctrl-C and SIGTERM set; a second signal has its usual effect."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop  # signals reach the main thread only
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def asked(number: int, _: object) -> None:
        stop.set()
        signal.signal(number, before[signal.Signals(number)])

    for number in before:
        signal.signal(number, asked)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
