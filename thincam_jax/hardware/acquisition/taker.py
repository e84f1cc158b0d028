"""Taking the frame of one step: move, show, settle, flush, trigger, check.

A pattern that stands on the display already is not shown again. After a transient error the step is
repeated from its beginning, and a disconnected device is reopened; every other error is the
caller's.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np

from thincam_jax._core.arguments import checked
from thincam_jax._core.quantity import check_fields, choice, quantity, whole
from thincam_jax.hardware.acquisition.plan import AcquisitionPlan, AcquisitionStep
from thincam_jax.hardware.acquisition.rig import Rig, Role
from thincam_jax.hardware.base import (
    CameraSettings,
    Disconnected,
    Frame,
    HardwareError,
    IncompleteFrame,
    NotFound,
    NotHomed,
    OutOfRange,
    ProtocolError,
    Saturated,
    Timeout,
    grab,
)

# The exposure that is found has this quantile of the pixels at the target, a part of full scale.
QUANTILE, _TARGET, _TOLERANCE = 0.999, 0.7, 0.1
_SHORTEST, _LONGEST, _ATTEMPTS = 1e-5, 1.0, 12  # s, and frames at most
_MOST = 8.0  # largest factor from one exposure to the next
_REMEDY = "change the light"


@checked
def find_exposure(level_at: Callable[[float], float], start: float, camera: str) -> float:
    """Exposure, s, at which `level_at` reaches 0.7 within a tenth.

    - `level_at`: takes a frame with an exposure and returns its level as a fraction of full scale.

    The level grows linearly with the exposure, apart from an offset, up to saturation.

    **Errors**: Saturated where 10 µs are too bright; OutOfRange where 1 s is too dark, or the
    search does not end.
    """

    def within(exposure: float) -> float:
        return min(max(exposure, _SHORTEST), _LONGEST)

    exposure, level = within(start), 0.0
    for _ in range(_ATTEMPTS):
        level = level_at(exposure)
        if abs(level - _TARGET) <= _TOLERANCE * _TARGET:
            return exposure
        factor = 1 / _MOST if level >= 1 else _TARGET / max(level, _TARGET / _MOST)
        following = within(exposure * factor)
        if following == exposure:
            cause = f"level {level:.3g} at {exposure:g} s, {_TARGET:g} wanted"
            kind = Saturated if level > _TARGET else OutOfRange
            raise kind(camera, "find the exposure", cause, _REMEDY)
        exposure = following
    cause = f"level {level:.3g} after {_ATTEMPTS} frames, {_TARGET:g} wanted"
    raise OutOfRange(camera, "find the exposure", cause, _REMEDY)


TRANSIENT = (IncompleteFrame, Timeout, Disconnected)  # the step is repeated

_SECONDS = quantity("s", non_negative=True)


@dataclass(frozen=True)
class Procedure:
    """Timing, checks and error recovery of an acquisition.

    - `settle`: s from showing a pattern to the trigger; None: measured before the first frame.
    - `timeout`: s, beyond the exposure, that a frame may take.
    - `retries`: repetitions of a step after IncompleteFrame, Timeout and Disconnected.
    - `reopen_wait`: s before a disconnected device is reopened.
    - `saturated`: largest allowed share of saturated pixels.
    - `position_tolerance`: mm between the commanded position and the one reached, of a motor.
    - `exposure`: "given" with the plan, or found before the first frame, "auto": the first
      settings' by `find_exposure`; the others keep their ratio to it.
    """

    settle: Annotated[float | None, quantity("s", non_negative=True, optional=True)] = 0.0
    timeout: Annotated[float, _SECONDS] = 2.0
    retries: Annotated[int, whole(0, 100)] = 3
    reopen_wait: Annotated[float, _SECONDS] = 0.5
    saturated: Annotated[float, quantity(least=0.0, most=1.0)] = 0.01
    position_tolerance: Annotated[float, quantity("mm", non_negative=True)] = 0.01
    exposure: Annotated[Literal["given", "auto"], choice(("given", "auto"))] = "given"

    def __post_init__(self):
        check_fields(self)


class Taker:
    """The devices of a run and their known state.

    - `steps`: steps of the plan, each with its position: any may be the first of this process.
    - `recovered`: the errors that a retry resolved. `seconds`: spent on each part of a step.
    """

    def __init__(self, plan: AcquisitionPlan, rig: Rig, procedure: Procedure):
        self.plan, self.rig, self.procedure = plan, rig, procedure
        self.steps = plan.placed()
        self.recovered: list[str] = []
        self.seconds: dict[str, float] = {}
        self.identities = rig.identities()
        self._role: Role = "camera"  # of the device in use
        self.forget()
        self.bits: int | None = None  # of every frame, from the first
        self._seen: tuple[int, np.ndarray] | None = None  # pattern and pixels of the last frame

    def shape(self, settings: CameraSettings) -> tuple[int, int]:
        """Rows and columns of a frame with these settings."""
        region = settings.region
        return (region.height, region.width) if region else self.rig.camera.sensor_shape

    @contextmanager
    def clock(self, what: str) -> Iterator[None]:
        """Add the time spent within to `seconds`."""
        started = time.perf_counter()
        try:
            yield
        finally:
            spent = time.perf_counter() - started
            self.seconds[what] = self.seconds.get(what, 0.0) + spent

    def take(
        self, step: AcquisitionStep, settings: CameraSettings, *, probe: bool = False
    ) -> tuple[Frame, dict[str, Any]]:
        """Frame of a step, and its record for the journal. A `probe` may be saturated."""
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
        """Result of `action`, repeated a few times after transient errors."""
        for left in reversed(range(self.procedure.retries + 1)):
            try:
                return action()
            except TRANSIENT as error:
                if not left:
                    raise
                self.recover(error)
                self.recovered.append(f"{type(error).__name__}: {error}")
        raise AssertionError  # for the type: the last attempt returns or raises

    def recover(self, error: HardwareError) -> None:
        """Prepare the devices for repeating the step from its beginning."""
        role = self._role
        if isinstance(error, Disconnected):
            self._reopen(role, error)
        elif isinstance(error, Timeout) and role == "camera":
            time.sleep(self.procedure.timeout)  # a late frame arrives now, and is flushed
        last = None if role == "camera" and isinstance(error, Disconnected) else self._last
        self.forget()
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
                cause, remedy = f"{is_now} is there in its place", f"connect {self.name(role)}"
                raise NotFound(self.name(role), "open again", cause, remedy) from error
            return
        raise error from failure

    def forget(self) -> None:
        """Forget the devices' state, so that all is set again."""
        self._last: int | None = None  # number of the last frame
        self._configured: CameraSettings | None = None
        self._shown: int | None = None  # number of the pattern
        self._asked: float | None = None  # commanded position of the stage, and the reported one
        self._position: float | None = None

    def _once(
        self, step: AcquisitionStep, settings: CameraSettings, probe: bool
    ) -> tuple[Frame, dict[str, Any]]:
        """Frame of a step, its number of saturated pixels, and the stage's position."""
        position = self._moved(step)
        if shown := step.pattern != self._shown:
            with self.clock("show"):
                levels = self.rig.render(self.plan.pattern(step))
                self._role, self._shown = "display", None
                self.rig.display.show(levels)
        self._role = "camera"
        camera = self.rig.camera
        self.configure(settings)
        if shown and self.procedure.settle:
            with self.clock("settle"):
                time.sleep(self.procedure.settle)
        self._shown = step.pattern
        with self.clock("flush"):
            camera.flush()
        with self.clock("trigger"):
            frame = grab(camera, self.procedure.timeout)
        with self.clock("check"):
            # A copy, as drivers reuse their buffers.
            frame = replace(frame, pixels=np.array(frame.pixels))
            saturated = self._check(frame, settings, probe or self._is_bracketed(step))
            self._refuse_repeated(step, frame.pixels)
        self._last = frame.number
        return frame, {"saturated": saturated, "position": position}

    def _moved(self, step: AcquisitionStep) -> float | None:
        """Reported position of the stage after its move; None without a stage."""
        stage = self.rig.stage
        if stage is None:
            return None
        self._role = "stage"
        with self.clock("move"):
            if step.position is not None and step.position != self._asked:
                reached, self._position = stage.move_to(step.position), stage.position()
                for place in () if stage.by_hand else (reached, self._position):
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
        """Apply settings exactly; ProtocolError where the camera takes others."""
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
        """Apply settings; returns the camera's nearest."""
        self._role, self._configured = "camera", None
        self._configured = self.rig.camera.configure(settings)
        return self._configured

    def _refuse_repeated(self, step: AcquisitionStep, pixels: np.ndarray) -> None:
        """Refuse identical pixels for another pattern: with new noise they would differ."""
        middle = len(pixels) // 2  # compared first, as it nearly always differs
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

    def _is_bracketed(self, step: AcquisitionStep) -> bool:
        """Whether a shorter exposure of the plan sees what this one saturates."""
        exposures = [one.exposure for one in self.plan.settings]
        bracket = bool(self.plan.facts.get("bracket"))
        return bracket and exposures[step.settings] > min(exposures)

    def _check(self, frame: Frame, settings: CameraSettings, probe: bool) -> int:
        """Number of saturated pixels; HardwareError for a wrong frame."""
        pixels, last, bits = frame.pixels, self._last, frame.bit_depth
        name, shape = self.name("camera"), self.shape(settings)
        held = 8 * pixels.dtype.itemsize * (pixels.dtype.name in ("uint8", "uint16"))
        if not 0 < bits <= held or not math.isfinite(frame.time):
            cause = f"a frame of {bits} bits as {pixels.dtype}, at {frame.time:g} s"
            raise ProtocolError(name, "trigger", cause, "mend its driver: see Frame")
        full, highest = full_scale(frame), int(pixels.max(initial=0))
        exposed = math.isclose(frame.exposure, settings.exposure, rel_tol=0.01, abs_tol=2e-6)
        for wrong, error, cause in (
            (last is not None and frame.number <= last, IncompleteFrame,
             f"frame {frame.number} came after frame {last}: a stale one"),
            (pixels.shape != shape, IncompleteFrame,
             f"the frame has the shape {pixels.shape}, not {shape}"),
            (bits != (self.bits or bits), ProtocolError,
             f"the frame has {bits} bits, not {self.bits}"),
            (not exposed, ProtocolError,
             f"exposed for {frame.exposure:g} s, not for {settings.exposure:g} s"),
            (highest > full, ProtocolError,
             f"a count of {highest}, and {bits} bits end at {full}"),
        ):  # fmt: skip
            if wrong:
                raise error(name, "trigger", cause, "check the cable and its driver")
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
        return str(self.identities[role])


def full_scale(frame: Frame) -> int:
    """Largest count of a frame."""
    return 2**frame.bit_depth - 1


def _same(first: CameraSettings, second: CameraSettings) -> bool:
    """Whether two settings agree up to the rounding of registers."""
    both = (first, second)
    exact = {(one.region, one.pixel_format, one.binning, one.trigger) for one in both}
    levels = [one.black_level for one in both if one.black_level is not None]
    return (
        len(exact) == 1
        and math.isclose(min(levels, default=0), max(levels, default=0), abs_tol=1e-3)
        and math.isclose(first.exposure, second.exposure, rel_tol=1e-4)
        and math.isclose(first.gain, second.gain, abs_tol=1e-3)
    )
