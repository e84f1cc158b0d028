"""The devices of an acquisition, which can be reopened."""

from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from typing import Any, Literal

import numpy as np

from thincam_jax.hardware.acquisition.plan import Pattern
from thincam_jax.hardware.base import Camera, Display, Identity, Stage

Role = Literal["camera", "display", "stage"]


class Rig(AbstractContextManager["Rig"]):
    """Camera, display and an optional stage; a context manager that closes them.

    - `open_camera`, `open_display`, `open_stage`: open the device, also after it was unplugged,
      such as `functools.partial(open_device, "cameras", "pylon", options)`.
    - `render`: draws a pattern as levels (y, x), uint8, of the display's shape.

    **Errors**: those of the drivers; devices opened before are closed.
    """

    camera: Camera
    display: Display
    stage: Stage | None

    def __init__(
        self,
        open_camera: Callable[[], Camera],
        open_display: Callable[[], Display],
        render: Callable[[Pattern], np.ndarray],
        open_stage: Callable[[], Stage] | None = None,
    ):
        self.render = render
        self._openers: dict[str, Any] = {"camera": open_camera, "display": open_display}
        with ExitStack() as opened:
            self.camera = opened.enter_context(open_camera())
            self.display = opened.enter_context(open_display())
            self.stage = None
            if open_stage is not None:
                self._openers["stage"] = open_stage
                self.stage = opened.enter_context(open_stage())
            opened.pop_all()

    def reopen(self, role: Role) -> None:
        """Close a disconnected device and open it again."""
        getattr(self, role).close()
        setattr(self, role, self._openers[role]())

    def identities(self) -> dict[str, Identity]:
        """Identity of each device."""
        return {role: getattr(self, role).identity for role in self._openers}

    def close(self) -> None:
        """Release the devices."""
        for device in (self.camera, self.display, self.stage):
            if device is not None:
                device.close()

    def __exit__(self, *_: object) -> None:
        self.close()
