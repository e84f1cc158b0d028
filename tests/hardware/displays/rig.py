"""A virtual panel, a camera that looks at it, and a clock that stands still between sleeps."""

from collections.abc import Callable

import numpy as np

from thincam_jax.hardware import Camera, CameraSettings
from thincam_jax.hardware.base import Frame, Identity
from thincam_jax.hardware.virtual.devices import VirtualDisplay


class Clock:
    """In place of the module `time`."""

    def __init__(self):
        self.now = 0.0

    def perf_counter(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


class Panel(VirtualDisplay):
    """Its levels follow exponentially: exp(−t/`response`) of the pattern before is left."""

    def __init__(self, shape: tuple[int, int], response: float = 0.0, clock: Clock | None = None):
        super().__init__(shape, self._follow)
        self.response, self.clock = response, clock or Clock()
        self.before = self.target = np.zeros(shape, np.float32)
        self.since = 0.0

    def levels(self) -> np.ndarray:
        """Levels at this moment, float32 from 0 to 255."""
        if not self.response:
            return self.target
        left = np.float32(np.exp((self.since - self.clock.now) / self.response))
        return self.target + left * (self.before - self.target)

    def _follow(self, levels: np.ndarray) -> None:
        self.before, self.target = self.levels(), levels.astype(np.float32)
        self.since = self.clock.now


class PanelCamera(Camera):
    """A 12 bit camera, pixel by pixel of the panel; `counts` of its levels, with noise."""

    def __init__(
        self, display: Panel, counts: Callable[[np.ndarray], np.ndarray], noise: float = 2.0
    ):
        self.display, self.counts, self.noise = display, counts, noise
        self.random, self.number = np.random.default_rng(11), 0

    identity = Identity("test", "camera", "1")

    @property
    def sensor_shape(self):
        return self.display.shape

    def configure(self, settings: CameraSettings) -> CameraSettings:
        return settings

    def flush(self) -> None:
        pass

    def close(self) -> None:
        pass

    def trigger_and_grab(self, timeout: float) -> Frame:
        seen = self.counts(self.display.levels())
        seen = seen + self.noise * self.random.standard_normal(seen.shape)
        self.number += 1
        pixels = np.clip(np.rint(seen), 0, 4095).astype(np.uint16)
        return Frame(pixels, self.number, 0.0, 1e-3, 12)
