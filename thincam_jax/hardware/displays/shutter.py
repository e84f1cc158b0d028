"""Someone who covers the camera for its dark frames, in place of a display."""

from dataclasses import dataclass

import numpy as np

from thincam_jax.hardware.base import Display, Identity
from thincam_jax.hardware.errors import NotFound


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
