"""What the displays of grey levels have in common: checked patterns and the table of levels."""

from abc import abstractmethod

import numpy as np

from thincam_jax.hardware.base import Display
from thincam_jax.hardware.displays.grey_levels import GreyLevels
from thincam_jax.hardware.errors import OutOfRange


class Screen(Display):
    """A display of 256 levels; with `grey_levels`, in equal steps of the irradiance."""

    def __init__(self, grey_levels: GreyLevels | None = None):
        self.grey_levels = grey_levels

    def show(self, pattern: np.ndarray) -> None:
        if pattern.shape != self.shape or pattern.dtype != np.uint8:
            cause = f"a pattern {pattern.shape} of {pattern.dtype}"
            remedy = f"give uint8 levels of shape {self.shape}"
            raise OutOfRange(str(self.identity), "show", cause, remedy)
        self._present(pattern if self.grey_levels is None else self.grey_levels(pattern))

    @abstractmethod
    def _present(self, levels: np.ndarray) -> None:
        """Presents levels as they are, and returns once they are."""
