r"""Settling time of a display, and the person who covers the camera for dark frames.

Two patterns A and B are shown in turn. With the difference D of their settled frames, a frame
:math:`f` exposed a time t after the change from A to B contains the fraction

.. math:: r(t) = \langle f - f_B,\, D \rangle / \langle D,\, D \rangle, \qquad D = f_A - f_B

of A: 1 before any change, 0 once settled. As a mean over all pixels it detects residues far below
the noise of one pixel.
"""

import time
from dataclasses import dataclass

import numpy as np

from thincam_jax.hardware.base import Camera, Display, Identity, NotFound, OutOfRange, Timeout, grab

LONGEST = 0.5  # s, after which a display counts as settled
_SHOTS = 4  # of each measured fraction
_SWEEP = 8  # delays before bisection, which follow a ringing response to its end
_BISECTIONS = 5
_SIGMAS = 2.0


def settle_calibrate(
    display: Display,
    camera: Camera,
    patterns: tuple[np.ndarray, np.ndarray] | None = None,
    *,
    tolerance: float = 0.01,
    longest: float = LONGEST,
    timeout: float = 1.0,
) -> float:
    """Find the settle time, from the return of `show` to the call of `trigger_and_grab`, in s.

    After it at most `tolerance` of the previous pattern is left. The longer of both directions,
    black to white and back or between two `patterns` of the display's shape. It excludes the
    driver's delay before the trigger, so that it is valid for this camera and its exposure or a
    longer one. After `longest` the display counts as settled.

    **Errors**: Timeout where it is not settled after `longest`; OutOfRange where the camera does
    not distinguish the patterns well enough for the tolerance; those of the devices.
    """
    if patterns is None:
        black = np.zeros(display.shape, np.uint8)
        patterns = black, ~black
    device, operation = f"{display.identity} seen by {camera.identity}", "find the settle time"
    rig = _Rig(display, camera, patterns, longest, timeout)
    if not np.any(rig.difference):
        cause = "both patterns give the same frame"
        raise OutOfRange(device, operation, cause, "check that the camera sees the display")
    if _SIGMAS * rig.noise > tolerance / 2:
        cause = f"noise of {rig.noise:.2g} of the patterns' contrast, tolerance {tolerance:g}"
        raise OutOfRange(device, operation, cause, "expose longer or allow a larger tolerance")

    def settled(delay: float) -> tuple[float, float, int]:
        """Delay and fraction; 1 for settled, −1 for not settled, 0 where noise leaves it open."""
        actual, part = rig.part(delay)
        margin = _SIGMAS * rig.noise
        return actual, part, int(part + margin <= tolerance) - int(part - margin > tolerance)

    found, part, verdict = settled(longest)
    if verdict != 1:
        cause = f"{part:.2g} of the pattern before after {longest:g} s"
        raise Timeout(device, operation, cause, "raise longest")
    undecided = 0.0
    for delay in np.linspace(longest, 0.0, _SWEEP + 1)[1:]:
        actual, _, verdict = settled(float(delay))
        if verdict != 1:
            undecided = max(undecided, actual)
        elif not undecided:
            found = actual
        if verdict == -1:
            break
    for _ in range(_BISECTIONS):
        actual, _, verdict = settled((undecided + found) / 2)
        if verdict == 1:
            found = min(found, actual)
        else:
            undecided = max(undecided, actual)
    return found


class _Rig:
    """Settled frames of two patterns, and the fraction of one left after a change."""

    def __init__(self, display: Display, camera: Camera, patterns, longest: float, timeout: float):
        self._display, self._camera, self._patterns = display, camera, patterns
        self._longest, self._timeout = longest, timeout
        stacks = [self._at_rest(pattern) for pattern in patterns]
        self._rest = [stack.mean(axis=0) for stack in stacks]
        self.difference = self._rest[0] - self._rest[1]
        energy = np.vdot(self.difference, self.difference)
        self._probe = self.difference / energy if energy else self.difference
        scatter = [np.tensordot(stack, self._probe, 2) for stack in stacks]
        # A fraction and its reference are means of equally many shots.
        self.noise = float(np.sqrt(np.mean(np.var(scatter, axis=1, ddof=1)) * 2 / _SHOTS))

    def part(self, delay: float) -> tuple[float, float]:
        """Actual delay in s, and the larger fraction of both directions."""
        parts, delays = np.zeros((2, _SHOTS)), []
        for shot in range(_SHOTS):
            for new, sign in ((1, 1.0), (0, -1.0)):
                self._stand(1 - new, self._longest)
                delays.append(self._stand(new, delay))
                seen = self._grab() - self._rest[new]
                parts[new, shot] = sign * np.vdot(seen, self._probe)
        return float(np.mean(delays)), float(np.abs(parts.mean(axis=1)).max())

    def _at_rest(self, pattern: np.ndarray) -> np.ndarray:
        frames = []
        for _ in range(2 + _SHOTS):
            self._display.show(pattern)
            time.sleep(self._longest)
            frames.append(self._grab())
        return np.stack(frames[2:])

    def _stand(self, number: int, delay: float) -> float:
        self._display.show(self._patterns[number])
        start = time.perf_counter()
        time.sleep(delay)
        return time.perf_counter() - start

    def _grab(self) -> np.ndarray:
        return grab(self._camera, self._timeout).pixels.astype(float)


class Shutter(Display):
    """Shutter by hand for a camera without a display: a black pattern asks to cover it.

    A pattern is one level. The camera is taken for open at first, except after `forget`.

    - `display`: a phase modulator, on which no pattern is dark, and which shows the others.
    """

    shape = (1, 1)
    identity = Identity("thincam_jax", "shutter by hand", "1")

    @dataclass(frozen=True)
    class Options:
        """None."""

    def __init__(self, options: Options, display: Display | None = None):
        self._is_open: bool | None = True
        self._display = display
        if display is not None:
            self.shape, self.identity = display.shape, display.identity

    def forget(self) -> None:
        """Ask at the next pattern, whichever it is: an earlier run may have left a cover."""
        self._is_open = None

    def show(self, pattern: np.ndarray) -> None:
        wanted = bool(pattern.any())
        if wanted != self._is_open:
            action = "uncover" if wanted else "cover"
            try:
                input(f"{action} the camera, then press Enter: ")
            except EOFError as error:
                raise NotFound(
                    str(self.identity), f"{action} the camera", "nobody answers at a terminal",
                    "begin it in one, or set dark_frames to 0"
                ) from error  # fmt: skip
        self._is_open = wanted
        if wanted and self._display is not None:
            self._display.show(pattern)

    def close(self) -> None:
        if self._display is not None:
            self._display.close()
