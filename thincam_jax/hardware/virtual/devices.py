"""The devices of a virtual rig, opened by the drivers of real ones.

They use the real protocols: USB3 Vision behind a backend of pyusb in this process, the vendor's
emulator for pylon, Zaber and GRBL on pseudo-terminals. Only a display has no protocol. Nothing
listens on a network. Where the library of a driver is missing, a plain device takes its place.
"""

import logging
from collections.abc import Mapping
from contextlib import AbstractContextManager, ExitStack
from typing import Any

from thincam_jax.hardware import registry
from thincam_jax.hardware.base import Camera, Display, Stage
from thincam_jax.hardware.errors import NotFound
from thincam_jax.hardware.virtual.display import VirtualDisplay
from thincam_jax.hardware.virtual.faults import Faults
from thincam_jax.hardware.virtual.plain import PlainCamera, PlainStage
from thincam_jax.hardware.virtual.rig import VirtualRig


class VirtualDevices(AbstractContextManager["VirtualDevices"]):
    """The devices of one `VirtualRig`; a context manager.

    `camera`, `stage` and `display` connect, repeatedly, as the openers of an acquisition's rig. A
    reopened device is the same one: a stage stays homed as long as it has power. `faults` are those
    of each, by "camera", "stage" and "display".
    """

    def __init__(self, rig: VirtualRig):
        self.rig = rig
        self.faults = {role: Faults() for role in ("camera", "stage", "display")}
        self._there: dict[str, Any] = {}
        self._powered = ExitStack()

    def camera(self, driver: str, options: Mapping[str, Any] | None = None) -> Camera:
        """Open the camera by usb3_vision or pylon; `options` except the camera's address."""
        if driver not in ("usb3_vision", "pylon"):
            raise _none_virtual("cameras", driver, "usb3_vision or pylon")
        shape, faults = self.rig.optics.sensor_shape, self.faults["camera"]
        if _lacks_library("cameras", driver):
            return PlainCamera(self.rig.expose, shape)
        if driver == "pylon":
            from thincam_jax.hardware.virtual.pylon import VirtualPylonCamera

            return VirtualPylonCamera(self.rig.expose, shape, faults)
        from thincam_jax.hardware.virtual.usb3_vision import VirtualUsb3Vision

        if "camera" not in self._there:
            self._there["camera"] = VirtualUsb3Vision(self.rig.expose, shape, faults=faults)
        backend = self._there["camera"]
        return registry.open_device(
            "cameras", driver, {**(options or {}), "serial": "", "backend": backend}
        )

    def stage(self, driver: str, options: Mapping[str, Any] | None = None) -> Stage:
        """Open the stage by zaber or grbl; `options` except its port."""
        if driver not in ("zaber", "grbl"):
            raise _none_virtual("stages", driver, "zaber or grbl")
        if _lacks_library("stages", driver):
            self._there.setdefault("stage", PlainStage(self.rig.on_move))
            return self._there["stage"]
        if "stage" not in self._there:
            from thincam_jax.hardware.virtual.grbl import VirtualGrbl
            from thincam_jax.hardware.virtual.zaber import VirtualZaber

            kind = VirtualZaber if driver == "zaber" else VirtualGrbl
            device = kind(faults=self.faults["stage"], on_move=self.rig.on_move)
            self._there["stage"] = self._powered.enter_context(device)
        port = str(self._there["stage"].port)
        return registry.open_device("stages", driver, {**(options or {}), "port": port})

    def display(self, driver: str = "", options: Mapping[str, Any] | None = None) -> Display:
        """Open the display, whose patterns go to the rig, whatever the driver and its options."""
        shape, faults = self.rig.display_shape, self.faults["display"]
        return VirtualDisplay(shape, self.rig.on_show, faults=faults)

    def close(self) -> None:
        """Switch off the devices."""
        self._powered.close()

    def __exit__(self, *_: object) -> None:
        self.close()


def _lacks_library(kind: str, driver: str) -> bool:
    """Whether a driver cannot be imported, which is logged."""
    try:
        registry.driver(kind, driver)
    except NotFound as error:
        text = "%s; the virtual rig goes on without its protocol and faults"
        logging.getLogger(__name__).warning(text, error)
        return True
    return False


def _none_virtual(kind: str, driver: str, known: str) -> NotFound:
    return NotFound(driver, "open", f"there is no virtual one among the {kind}", f"use {known}")
