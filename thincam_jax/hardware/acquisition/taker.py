"""Takes the frame of one step: move, show, settle, flush, trigger, check.

What fails in a way that may pass is done again from the beginning of the step, and a device that
has gone is opened again; every other error is the caller's.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from thincam_jax._core.quantity import check_fields, quantity, whole
from thincam_jax.hardware.acquisition.auto_exposure import AutoExposure
from thincam_jax.hardware.acquisition.plan import Plan, Step
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

_SECONDS = quantity("s", non_negative=True)


@dataclass(frozen=True)
class Procedure:
    """Procedure by which frames are taken, and recovery where one fails.

    - `settle`: time, s, that the display takes after a pattern is shown.
    - `timeout`: s, beyond the exposure, that a frame may take.
    - `retries`: how often a step is done again after IncompleteFrame, Timeout and Disconnected.
    - `reopen_wait`: s before a device that has gone is opened again.
    - `saturated`: largest share of pixels at the largest count.
    - `position_tolerance`: mm between the position asked for and the one reached.
    - `auto_exposure`: find the exposure before the first frame; None: the plan's.
    """

    settle: Annotated[float, _SECONDS] = 0.0
    timeout: Annotated[float, _SECONDS] = 2.0
    retries: Annotated[int, whole(0, 100)] = 3
    reopen_wait: Annotated[float, _SECONDS] = 0.5
    saturated: Annotated[float, quantity(least=0.0, most=1.0)] = 1e-3
    position_tolerance: Annotated[float, quantity("mm", non_negative=True)] = 0.01
    auto_exposure: AutoExposure | None = None

    def __post_init__(self):
        check_fields(self)


class Taker:
    """The devices of a run, and what is known of their state.

    - `recovered`: the errors that a retry helped against. `seconds`: spent on each part of a step.
    """

    def __init__(self, plan: Plan, rig: Rig, procedure: Procedure):
        self.plan, self.rig, self.procedure = plan, rig, procedure
        self.recovered: list[str] = []
        self.seconds: dict[str, float] = {}
        self.identities = rig.identities()
        self._role: Role = "camera"  # of the device that is being used
        self._forget()
        self.bits: int | None = None  # of every frame, once the first has told it
        self._seen: tuple[int, np.ndarray] | None = None  # pattern and pixels of the last frame

    def shape(self, settings: CameraSettings) -> tuple[int, int]:
        """Rows and columns of a frame with these settings."""
        region = settings.region
        return (region.height, region.width) if region else self.rig.camera.sensor_shape

    @contextmanager
    def clock(self, what: str) -> Iterator[None]:
        """Adds the time spent within to `seconds`."""
        started = time.perf_counter()
        try:
            yield
        finally:
            spent = time.perf_counter() - started
            self.seconds[what] = self.seconds.get(what, 0.0) + spent

    def take(
        self, step: Step, settings: CameraSettings, *, probe: bool = False
    ) -> tuple[Frame, dict[str, Any]]:
        """The frame of a step, and how it was taken. A `probe` may be saturated."""
        before = len(self.recovered)
        frame, seen = self.persist(lambda: self._once(step, settings, probe))
        return frame, {
            **seen,
            "number": int(frame.number),
            "time": float(frame.time),
            "exposure": float(frame.exposure),
            "retries": len(self.recovered) - before,
        }

    def persist(self, action: Callable[[], Any]) -> Any:
        """Result of `action`; transient faults are recovered from, a few times."""
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
            if is_now != self.identities[role]:
                raise NotFound(
                    self.name(role), "open again", f"{told(is_now)} is there in its place",
                    f"connect {told(self.identities[role])}"
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
        """The frame of a step, how many of its pixels are full, and where the stage stands."""
        position = self._moved(step)
        with self.clock("show"):
            levels = self.rig.render(self.plan.pattern(step))
            self._role = "display"
            self.rig.display.show(levels)
        self._role = "camera"
        camera = self.rig.camera
        self.configure(settings)
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
                            self.name("stage"), f"move to {step.position:g} mm",
                            f"it stands at {place:g} mm and has lost steps",
                            "home it, and go on with the same command"
                        )  # fmt: skip
                self._asked = step.position
            elif self._position is None:
                self._position = stage.position()
        return float(self._position)  # pyright: ignore[reportArgumentType]

    def configure(self, settings: CameraSettings) -> None:
        """Set the camera as it was set when the store was begun; ProtocolError if it will not."""
        if settings == self._configured:
            return
        taken = self.set_near(settings)
        if not _same(taken, settings):
            raise ProtocolError(
                self.name("camera"), "configure", f"it took {taken} in place of {settings}",
                "undo what has changed, or begin another store"
            )  # fmt: skip
        self._configured = settings

    def set_near(self, settings: CameraSettings) -> CameraSettings:
        """Set the camera, and what it has taken instead."""
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
                self.name("camera"), "trigger",
                "the frame is that of the pattern before, digit for digit",
                "see that the camera sees the display"
            )  # fmt: skip
        self._seen = step.pattern, pixels

    def _check(self, frame: Frame, settings: CameraSettings, probe: bool) -> int:
        """Number of saturated pixels; HardwareError where it is not the frame asked for."""
        pixels, last = frame.pixels, self._last
        name, again = self.name("camera"), "check the cable and its driver"
        if last is not None and frame.number <= last:
            cause = f"frame {frame.number} came after frame {last}: a stale one"
            raise IncompleteFrame(name, "trigger", cause, again)
        if pixels.shape != (shape := self.shape(settings)):
            cause = f"the frame has the shape {pixels.shape}, not {shape}"
            raise IncompleteFrame(name, "trigger", cause, again)
        if self.bits is not None and frame.bit_depth != self.bits:
            cause = f"the frame has {frame.bit_depth} bits, not {self.bits}"
            raise ProtocolError(name, "trigger", cause, again)
        if not math.isclose(frame.exposure, settings.exposure, rel_tol=0.01, abs_tol=2e-6):
            cause = f"exposed for {frame.exposure:g} s, not for {settings.exposure:g} s"
            raise ProtocolError(name, "trigger", cause, again)
        full, highest = full_scale(frame), int(pixels.max())
        if highest > full:
            cause = f"a count of {highest}, and {frame.bit_depth} bits end at {full}"
            raise ProtocolError(name, "trigger", cause, again)
        saturated = int(np.count_nonzero(pixels == full)) if highest == full else 0
        share = saturated / pixels.size
        if share > self.procedure.saturated and not probe:
            raise Saturated(
                name, "trigger", f"{share:.2%} of the pixels are full, and "
                f"{self.procedure.saturated:.2%} may be",
                "begin another store with a shorter exposure, or allow more"
            )  # fmt: skip
        return saturated

    def name(self, role: Role) -> str:
        """Name of a device in messages."""
        return told(self.identities[role])


def full_scale(frame: Frame) -> int:
    """The largest count of a frame."""
    return 2**frame.bit_depth - 1


def told(identity: dict[str, str] | None) -> str:
    """A device's identity in a message."""
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
