"""Takes the frames of a plan, and survives what can go wrong on the way.

Each step is: move, show, settle, flush, trigger, check, keep. A step that fails in a way that may
pass is done again from its beginning; everything else stops the run, which `acquire` takes up again
where it stopped, with the same plan, devices and settings.
"""

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from thincam_jax._core.capture_store import (
    CALIBRATION,
    CAPTURES,
    TOGETHER,
    CaptureStore,
    CaptureStoreError,
    dtype_of_bits,
)
from thincam_jax.hardware.acquisition.auto_exposure import AutoExposure, find_exposure
from thincam_jax.hardware.acquisition.plan import HADAMARD, Plan, Step, settings_from
from thincam_jax.hardware.acquisition.recorder import (
    Layout,
    Lock,
    Recorder,
    create_store,
    now,
    require_space,
    versions,
)
from thincam_jax.hardware.acquisition.rig import Rig, Role
from thincam_jax.hardware.base import CameraSettings, Frame
from thincam_jax.hardware.errors import (
    Disconnected,
    HardwareError,
    IncompleteFrame,
    NotFound,
    NotHomed,
    ProtocolError,
    Saturated,
    Timeout,
)

PASSES = (IncompleteFrame, Timeout, Disconnected)  # a step that fails so is done again


@dataclass(frozen=True)
class Procedure:
    """How frames are taken, and what is done when one fails.

    - `settle`: time, s, that the display takes after a pattern is shown.
    - `timeout`: s, beyond the exposure, that a frame may take.
    - `retries`: how often a step is done again after IncompleteFrame, Timeout and Disconnected.
    - `reopen_wait`: s before a device that has gone is opened again.
    - `saturated_share`: largest share of pixels at the largest count.
    - `position_tolerance`: mm between the position asked for and the one reached.
    - `auto_exposure`: find the exposure before the first frame; None: the plan's.
    """

    settle: float = 0.0
    timeout: float = 2.0
    retries: int = 3
    reopen_wait: float = 0.5
    saturated_share: float = 1e-3
    position_tolerance: float = 0.01
    auto_exposure: AutoExposure | None = None


@dataclass(frozen=True)
class Progress:
    """After each frame: frames that are taken, of how many; frames per second, and s to go."""

    done: int
    total: int
    rate: float
    remaining: float


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    - `done`, `total`: frames in the store, and of the plan.
    - `recovered`: the errors that a retry helped against, one line each.
    - `seconds`: spent on "move", "show", "settle", "flush", "trigger", "check", "keep".
    """

    path: Path
    done: int
    total: int
    recovered: tuple[str, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        """Whether all frames are there; else the run was stopped and can be taken up again."""
        return self.done == self.total


def acquire(
    plan: Plan,
    rig: Rig,
    path: str | Path,
    *,
    procedure: Procedure = Procedure(),
    progress: Callable[[Progress], None] | None = None,
) -> Outcome:
    """Take the frames of a plan into the store at `path`, or those that it lacks.

    Ctrl-C and SIGTERM stop after the frame that is being taken, a second Ctrl-C at once. After an
    error, too, what was taken is kept, and the same call goes on.

    **Errors**: CaptureStoreError, one line, where the store is of another plan, device or setting,
    is being written by another run, or does not fit on the disk; the HardwareError that retries did
    not help against, or after which none makes sense: OutOfRange, NotHomed, Saturated and others.
    """
    path = Path(path).absolute()
    with _stop_asked() as stop, Lock(path):
        run = _Run(plan, rig, procedure)
        settings = run.begin(path)
        with Recorder(path) as recorder:
            todo, total = recorder.missing, len(plan.steps)
            require_space(path, len(todo) * run.frame_bytes)
            recorder.note({"begins": now(), "versions": versions(), "procedure": asdict(procedure)})
            done, started = total - len(todo), time.monotonic()
            for count, number in enumerate(todo, 1):
                if stop.is_set():
                    break
                step = plan.steps[number]
                frame, facts = run.take(step, settings[step.settings])
                with run.clock("keep"):
                    recorder.add(number, frame.pixels, facts)
                done += 1
                if progress is not None:
                    rate = count / max(time.monotonic() - started, 1e-9)
                    progress(Progress(done, total, rate, (total - done) / rate))
    return Outcome(path, done, total, tuple(run.recovered), run.seconds)


class _Run:
    """The devices of a run, and what is known of their state."""

    def __init__(self, plan: Plan, rig: Rig, procedure: Procedure):
        self.plan, self.rig, self.procedure = plan, rig, procedure
        self.recovered: list[str] = []
        self.seconds: dict[str, float] = {}
        self._identities = rig.identities()
        self._role: Role = "camera"  # of the device that is being used
        self._forget()
        self._shape: tuple[int, int] | None = None  # of the frames, and their bits, once known
        self._bits: int | None = None
        self._seen: tuple[int, np.ndarray] | None = None  # pattern and pixels of the last frame

    @property
    def frame_bytes(self) -> int:
        """Bytes that a frame takes on the disk."""
        return math.prod(self._shape or (0,)) * np.dtype(dtype_of_bits(self._bits)).itemsize

    @contextmanager
    def clock(self, what: str) -> Iterator[None]:
        """Adds the time spent within to `seconds`."""
        started = time.perf_counter()
        try:
            yield
        finally:
            spent = time.perf_counter() - started
            self.seconds[what] = self.seconds.get(what, 0.0) + spent

    def begin(self, path: Path) -> tuple[CameraSettings, ...]:
        """Create the store, or see that it is this run's; what the camera is set to for it."""
        moves = any(step.position is not None for step in self.plan.steps)
        if moves and self.rig.stage is None:
            raise ValueError(
                f"the plan {self.plan.name!r} moves a stage and the rig has none; give open_stage"
            )
        if moves and not self.rig.stage.homed:  # pyright: ignore[reportOptionalMemberAccess]
            raise NotHomed(
                self._name("stage"), "begin", "it does not know where it is", "home it first"
            )
        if path.exists():
            return self._resumed(path)
        settings = self._new_settings()
        first = self.plan.steps[0]
        frame, _ = self.take(first, settings[first.settings], probe=True)
        shape, bits = frame.pixels.shape, frame.bit_depth
        attributes = {
            "kind": CAPTURES,
            "sensor_shape": shape,
            "bits": bits,
            "acquisition": {
                "plan": self.plan.hash,
                "name": self.plan.name,
                "devices": self._identities,
                "settings": [asdict(one) for one in settings],
                "asked": [asdict(one) for one in self.plan.settings],
                "procedure": asdict(self.procedure),
                "versions": versions(),
                "begun": now(),
            },
        }
        together = 1
        if self.plan.name == HADAMARD:
            attributes |= {"kind": CALIBRATION, "exposure": settings[0].exposure}
            attributes |= {"stored_at": _stored_at(self.plan), **self.plan.facts["series"]}
            together = TOGETHER
        whole = (len(self.plan.steps), *shape)
        create_store(
            path, Layout(whole, dtype_of_bits(bits), together, attributes, self.plan.as_json())
        )
        self._shape, self._bits = shape, bits
        return settings

    def _resumed(self, path: Path) -> tuple[CameraSettings, ...]:
        """What the camera was set to when the store was begun, once all agrees with it."""
        store = CaptureStore(path)
        begun = store.attributes.get("acquisition")
        if begun is None:
            raise CaptureStoreError(f"{path} was not made by an acquisition; give another name")
        if begun["plan"] != self.plan.hash:
            raise CaptureStoreError(
                f"{path} was begun with another plan ({begun['name']}, {begun['plan'][:12]}), not "
                f"with this one ({self.plan.name}, {self.plan.hash[:12]}); give another name, or "
                "the plan it was begun with"
            )
        for role in sorted({*begun["devices"], *self._identities}):
            was, now_is = begun["devices"].get(role), self._identities.get(role)
            if was != now_is:
                raise CaptureStoreError(
                    f"{path} was begun with the {role} {_told(was)}, and this rig has "
                    f"{_told(now_is)}; connect that one, or give another name"
                )
        settings = tuple(settings_from(record) for record in begun["settings"])
        for one in settings:
            self._persist(lambda one=one: self._configure(one))
        self._shape, self._bits = store.frames.shape[1:], store.attributes["bits"]
        return settings

    def _new_settings(self) -> tuple[CameraSettings, ...]:
        """What the camera takes of the plan's settings, with the exposure that it needs."""
        asked, wanted = self.plan.settings, self.procedure.auto_exposure
        if wanted is not None:
            if len(asked) != 1:
                raise ValueError(
                    f"the plan {self.plan.name!r} has {len(asked)} settings; auto-exposure takes "
                    "plans with one"
                )
            lit = next((s for s in self.plan.steps if not s.dark), self.plan.steps[0])

            def level_at(exposure: float) -> float:
                settings = self._persist(lambda: self._set(replace(asked[0], exposure=exposure)))
                frame, _ = self.take(lit, settings, probe=True)
                return float(np.quantile(frame.pixels, wanted.quantile)) / _full(frame)

            found = find_exposure(level_at, asked[0].exposure, wanted, self._name("camera"))
            asked = (replace(asked[0], exposure=found),)
        return tuple(self._persist(lambda one=one: self._set(one)) for one in asked)

    def take(
        self, step: Step, settings: CameraSettings, *, probe: bool = False
    ) -> tuple[Frame, dict[str, Any]]:
        """The frame of a step, and how it was taken. A `probe` may be saturated."""
        before = len(self.recovered)
        frame, seen = self._persist(lambda: self._once(step, settings, probe))
        return frame, {
            **seen,
            "number": int(frame.number),
            "time": float(frame.time),
            "exposure": float(frame.exposure),
            "retries": len(self.recovered) - before,
        }

    def _persist(self, action: Callable[[], Any]) -> Any:
        """What `action` gives; what passes is recovered from, a few times."""
        for left in reversed(range(self.procedure.retries + 1)):
            try:
                return action()
            except PASSES as error:
                if not left:
                    raise
                self._recover(error)
                self.recovered.append(f"{type(error).__name__}: {error}")
        raise AssertionError  # for the type: the last attempt returns or raises

    def _recover(self, error: HardwareError) -> None:
        """Leave the devices so that the step can be done again from its beginning."""
        role = self._role
        if isinstance(error, Disconnected):
            self._reopen(role, error)
        elif isinstance(error, Timeout) and role == "camera":
            time.sleep(self.procedure.timeout)  # a frame that is late comes now, and is flushed
        last = None if role == "camera" and isinstance(error, Disconnected) else self._last
        self._forget()
        self._last = last

    def _reopen(self, role: Role, error: Disconnected) -> None:
        failure: HardwareError = error
        for _ in range(max(1, self.procedure.retries)):
            time.sleep(self.procedure.reopen_wait)
            try:
                self.rig.reopen(role)
                is_now = self.rig.identities()[role]
            except HardwareError as again:
                failure = again
                continue
            if is_now != self._identities[role]:
                raise NotFound(
                    self._name(role), "open again", f"{_told(is_now)} is there in its place",
                    f"connect {_told(self._identities[role])}"
                ) from error  # fmt: skip
            return
        raise error from failure

    def _forget(self) -> None:
        """Nothing is known of the devices' state: all is set again."""
        self._last: int | None = None  # number of the last frame
        self._configured: CameraSettings | None = None
        self._asked: float | None = None  # where the stage was sent, and where it says it is
        self._position: float | None = None

    def _once(
        self, step: Step, settings: CameraSettings, probe: bool
    ) -> tuple[Frame, dict[str, Any]]:
        """The frame of a step, its digest, its full pixels, and where the stage stands."""
        position = self._moved(step)
        with self.clock("show"):
            levels = self.rig.render(self.plan.pattern(step))
            self._role = "display"
            self.rig.display.show(levels)
        self._role = "camera"
        camera = self.rig.camera
        self._configure(settings)
        if self.procedure.settle:
            with self.clock("settle"):
                time.sleep(self.procedure.settle)
        with self.clock("flush"):
            camera.flush()
        with self.clock("trigger"):
            frame = camera.trigger_and_grab(self.procedure.timeout)
        with self.clock("check"):
            # A copy of its own: drivers use their buffers again.
            frame = replace(frame, pixels=np.array(frame.pixels))
            saturated = self._check(frame, settings, probe)
            self._refuse_twin(step, frame.pixels)
        self._last = frame.number
        return frame, {"saturated": saturated, "position": position}

    def _moved(self, step: Step) -> float | None:
        """Where the stage stands after it moved, as it says itself; None for none."""
        stage = self.rig.stage
        if stage is None:
            return None
        self._role = "stage"
        with self.clock("move"):
            if step.position is not None and step.position != self._asked:
                reached, self._position = stage.move_to(step.position), stage.position()
                for place in (reached, self._position):
                    if abs(place - step.position) > self.procedure.position_tolerance:
                        raise NotHomed(
                            self._name("stage"), f"move to {step.position:g} mm",
                            f"it stands at {place:g} mm and has lost steps",
                            "home it, and go on with the same command"
                        )  # fmt: skip
                self._asked = step.position
            elif self._position is None:
                self._position = stage.position()
        return float(self._position)  # pyright: ignore[reportArgumentType]

    def _configure(self, settings: CameraSettings) -> None:
        """Set the camera as it was set when the store was begun."""
        if settings == self._configured:
            return
        taken = self._set(settings)
        if not _same(taken, settings):
            raise ProtocolError(
                self._name("camera"), "configure", f"it took {taken} in place of {settings}",
                "undo what has changed, or begin another store"
            )  # fmt: skip
        self._configured = settings

    def _set(self, settings: CameraSettings) -> CameraSettings:
        self._role, self._configured = "camera", None
        return self.rig.camera.configure(settings)

    def _refuse_twin(self, step: Step, pixels: np.ndarray) -> None:
        """Noise makes frames differ: the same pixels for another pattern are an old frame."""
        middle = len(pixels) // 2  # differs nearly always, and saves reading the others
        if (
            self._seen is not None
            and self._seen[0] != step.pattern
            and not step.dark
            and np.array_equal(self._seen[1][middle], pixels[middle])
            and np.array_equal(self._seen[1], pixels)
        ):
            raise IncompleteFrame(
                self._name("camera"), "trigger",
                "the frame is that of the pattern before, digit for digit",
                "see that the camera sees the display"
            )  # fmt: skip
        self._seen = step.pattern, pixels

    def _check(self, frame: Frame, settings: CameraSettings, probe: bool) -> int:
        """How many pixels are full; a HardwareError where it is not the frame asked for."""
        pixels, last = frame.pixels, self._last
        name, again = self._name("camera"), "check the cable and its driver"
        if last is not None and frame.number <= last:
            cause = f"frame {frame.number} came after frame {last}: a stale one"
            raise IncompleteFrame(name, "trigger", cause, again)
        if self._shape is not None and pixels.shape != self._shape:
            cause = f"the frame has the shape {pixels.shape}, not {self._shape}"
            raise IncompleteFrame(name, "trigger", cause, again)
        if self._bits is not None and frame.bit_depth != self._bits:
            cause = f"the frame has {frame.bit_depth} bits, not {self._bits}"
            raise ProtocolError(name, "trigger", cause, again)
        if not math.isclose(frame.exposure, settings.exposure, rel_tol=0.01, abs_tol=2e-6):
            cause = f"exposed for {frame.exposure:g} s, not for {settings.exposure:g} s"
            raise ProtocolError(name, "trigger", cause, again)
        full, highest = _full(frame), int(pixels.max())
        if highest > full:
            cause = f"a count of {highest}, and {frame.bit_depth} bits end at {full}"
            raise ProtocolError(name, "trigger", cause, again)
        saturated = int(np.count_nonzero(pixels == full)) if highest == full else 0
        share = saturated / pixels.size
        if share > self.procedure.saturated_share and not probe:
            raise Saturated(
                name, "trigger", f"{share:.2%} of the pixels are full, and "
                f"{self.procedure.saturated_share:.2%} may be",
                "begin another store with a shorter exposure, or allow more"
            )  # fmt: skip
        return saturated

    def _name(self, role: Role) -> str:
        return _told(self._identities[role])


def _full(frame: Frame) -> int:
    return 2**frame.bit_depth - 1


def _told(identity: dict[str, str] | None) -> str:
    if identity is None:
        return "none"
    return "{vendor} {model} ({serial})".format(**identity)


def _same(first: CameraSettings, second: CameraSettings) -> bool:
    """Whether two settings are the same, but for the rounding of registers."""
    return (
        (first.region, first.pixel_format) == (second.region, second.pixel_format)
        and math.isclose(first.exposure, second.exposure, rel_tol=1e-4)
        and math.isclose(first.gain, second.gain, abs_tol=1e-3)
    )


def _stored_at(plan: Plan) -> list[int]:
    """Where the store has each frame of a Hadamard series, which counts the dark ones last."""
    steps = range(len(plan.steps))
    return sorted(steps, key=lambda number: plan.steps[number].dark)


@contextmanager
def _stop_asked() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set; a second one does what it did before."""
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
