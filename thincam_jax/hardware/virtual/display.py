"""A display that hands each pattern to a function."""

import time
from collections.abc import Callable
from importlib.metadata import version

import numpy as np

from thincam_jax.hardware.base import Identity
from thincam_jax.hardware.displays.grey_levels import GreyLevelDisplay, GreyLevels
from thincam_jax.hardware.virtual.faults import Faults

_LATENCY = 0.05  # s


class VirtualDisplay(GreyLevelDisplay):
    """A display that calls `on_show` with the levels (y, x), uint8, of each pattern.

    `faults`: plays latency, a late `show`.
    """

    identity = Identity("thincam_jax", "virtual display", "virtual", version("thincam_jax"))

    def __init__(
        self,
        shape: tuple[int, int],
        on_show: Callable[[np.ndarray], None],
        *,
        faults: Faults | None = None,
        grey_levels: GreyLevels | None = None,
    ):
        super().__init__(grey_levels)
        self.shape, self._on_show, self._faults = shape, on_show, faults or Faults()

    def close(self) -> None:
        pass

    def _present(self, levels: np.ndarray) -> None:
        if self._faults.due("latency"):
            time.sleep(_LATENCY)
        self._on_show(levels)
