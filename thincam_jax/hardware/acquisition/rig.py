"""The devices of an acquisition, real or virtual, which can be reopened."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from thincam_jax.hardware.acquisition.plan import BLACK, WHITE, Pattern
from thincam_jax.hardware.base import Camera, Display, Identity, Stage
from thincam_jax.hardware.holder import held
from thincam_jax.hardware.registry import open_device

if TYPE_CHECKING:  # it brings JAX
    from thincam_jax.hardware.virtual.rig import VirtualRig

Role = Literal["camera", "display", "stage"]


class Rig(AbstractContextManager["Rig"]):
    """Camera, display and an optional stage; a context manager that closes them.

    - `open_camera`, `open_display`, `open_stage`: open the device, also after it was unplugged,
      such as `functools.partial(open_device, "cameras", "pylon", options)`.
    - `render`: draws a pattern as levels (y, x), uint8, of the display's shape.
    - `on_step`: called with the number of each step of a plan before its frame is taken.

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
        on_step: Callable[[int], None] = lambda number: None,
    ):
        self.render, self.on_step = render, on_step
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


@contextmanager
def open_rig(
    drivers: Mapping[Role, tuple[str, Mapping[str, Any]]],
    pitch: float,
    *,
    virtual: "VirtualRig | None" = None,
    pictures: Mapping[str, np.ndarray] | None = None,
    turns_phase: bool = False,
) -> Iterator[Rig]:
    """Open the devices of a rig and home its stage; a context manager.

    - `drivers`: name and options of the driver of the camera, the display and, if any, the stage.
    - `pitch`: pitch of the display's pixels, mm, for which zone plates are drawn.
    - `virtual`: simulated optics, whose virtual devices are opened in place of real ones.
    - `pictures`: pictures of a plan of pictures or pixels, by name.
    - `turns_phase`: the display is a phase modulator, which shows no black: someone covers the
      camera for dark frames.

    **Errors**: Busy for a device that another process holds; those of the drivers; ValueError for
    unknown options.
    """
    from thincam_jax.hardware.displays.patterns import pattern_levels
    from thincam_jax.hardware.displays.settle import Shutter
    from thincam_jax.hardware.virtual.devices import VirtualDevices

    with ExitStack() as stack:
        openers: dict[Any, Any] = {
            role: partial(open_device, f"{role}s", *given) for role, given in drivers.items()
        }
        if virtual is None:
            for name, options in drivers.values():
                if name != "shutter":
                    chosen = ", ".join(f"{key}: {value}" for key, value in options.items())
                    stack.enter_context(held(f"{name} {{{chosen}}}" if chosen else name))
            if turns_phase:
                shown = openers["display"]
                openers["display"] = lambda: Shutter(Shutter.Options(), shown())
        else:
            devices = stack.enter_context(VirtualDevices(virtual))
            openers = {role: partial(getattr(devices, role), *drivers[role]) for role in drivers}

        def render(pattern: Pattern) -> np.ndarray:
            if rig.display.shape == Shutter.shape:
                pattern = BLACK if pattern == BLACK else WHITE
            return pattern_levels(pattern, rig.display.shape, pitch, pictures)

        hooks = {} if virtual is None else {"on_step": virtual.on_step}
        rig = Rig(openers["camera"], openers["display"], render, openers.get("stage"), **hooks)
        stack.enter_context(rig)
        if rig.stage is not None and not rig.stage.homed:
            rig.stage.home()
        yield rig
