"""A display that hands each pattern to a function, with the panel's slow response."""

import time
from collections.abc import Callable
from importlib.metadata import version

import numpy as np

from thincam_jax.hardware.base import Identity
from thincam_jax.hardware.displays.grey_levels import GreyLevels, Screen
from thincam_jax.hardware.virtual.faults import Faults

_LATENCY = 0.05  # s


class VirtualDisplay(Screen):
    """A panel whose levels follow exponentially: of the pattern before, exp(−t/`response`) is left.

    - `on_show`: gets the levels (y, x) of uint8 when they are presented.
    - `response`: time constant in s; 0 for a panel without inertia. `levels` is what it shows now.
    - `faults`: plays latency, the time of a late `show`.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        on_show: Callable[[np.ndarray], None] | None = None,
        *,
        response: float = 0.0,
        faults: Faults | None = None,
        grey_levels: GreyLevels | None = None,
    ):
        super().__init__(grey_levels)
        own = version("thincam_jax")
        self._identity = Identity("thincam_jax", "virtual display", "virtual", own)
        self._shape, self._on_show, self._response = shape, on_show, response
        self._faults = faults or Faults()
        self._before = self._target = np.zeros(shape, np.float32)
        self._presented = time.perf_counter()

    def levels(self) -> np.ndarray:
        """Levels of the panel at this moment, float32 from 0 to 255."""
        if not self._response:
            return self._target
        left = np.float32(np.exp((self._presented - time.perf_counter()) / self._response))
        return self._target + left * (self._before - self._target)

    def close(self) -> None:
        pass

    def _present(self, levels: np.ndarray) -> None:
        if self._faults.due("latency"):
            time.sleep(_LATENCY)
        self._before, self._target = self.levels(), levels.astype(np.float32)
        self._presented = time.perf_counter()
        if self._on_show is not None:
            self._on_show(levels)
