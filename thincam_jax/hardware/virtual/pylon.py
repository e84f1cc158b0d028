"""A camera whose frames come from a function, behind Basler's emulator."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import tifffile

from thincam_jax.hardware.base import CameraSettings, Frame, OutOfRange
from thincam_jax.hardware.cameras.features import BIT_DEPTHS
from thincam_jax.hardware.cameras.pylon import PylonCamera, pylon
from thincam_jax.hardware.virtual.devices import Faults

_EMULATOR = "BaslerCamEmu"
_LATENCY = 0.05  # s
_DELIVERY = 5.0  # s, at most, until a frame arrives from the emulator's thread


class VirtualPylonCamera(PylonCamera):
    """`PylonCamera` on pylon's emulator, which reads the frame of each trigger from a file.

    - `expose`: returns the counts (y, x) of a frame exposed now, within the settings' region.
    - `sensor_shape`: rows and columns, at most 4096 each.
    - `faults`: plays latency, stale_frame, short_frame, dropped_frame and unplug.
    """

    def __init__(
        self,
        expose: Callable[[CameraSettings], np.ndarray],
        sensor_shape: tuple[int, int],
        faults: Faults | None = None,
    ):
        os.environ["PYLON_CAMEMU"] = "1"
        self._expose, self._sensor_shape = expose, sensor_shape
        self._faults = faults or Faults()
        self._files = TemporaryDirectory(prefix="thincam-pylon-")
        wanted = pylon.DeviceInfo()
        wanted.SetDeviceClass(_EMULATOR)
        factory: Any = pylon.TlFactory.GetInstance()
        super().__init__(pylon.InstantCamera(factory.CreateFirstDevice(wanted)))

    def _introduce(self) -> None:
        super()._introduce()
        largest = super().sensor_shape
        if self._sensor_shape[0] > largest[0] or self._sensor_shape[1] > largest[1]:
            remedy = f"give at most {largest[0]} × {largest[1]} pixels"
            raise OutOfRange(self._name, "open", f"a sensor of {self._sensor_shape}", remedy)
        # The emulator lists the folder once and reads a file only if it is not the one before.
        self._folder = Path(self._files.name, "frames")
        self._folder.mkdir()
        self._put(np.zeros((1, 1), np.uint16), 16)
        for name, value in (
            ("TestImageSelector", "Off"),
            ("ImageFilename", str(self._folder)),
            ("ImageFileMode", "On"),
        ):
            self._features.set(name, value)

    @property
    def sensor_shape(self) -> tuple[int, int]:
        rows, columns = self._sensor_shape
        binning = int(self._features.get("BinningVertical"))
        return rows // binning, columns // binning

    def trigger_and_grab(self, timeout: float) -> Frame:
        if self._camera.IsGrabbing() and self._faults.due("stale_frame"):
            super()._trigger()  # an earlier frame is queued before the next one
            last = time.monotonic() + _DELIVERY
            while not self._camera.NumReadyBuffers.Value and time.monotonic() < last:
                time.sleep(1e-3)
        return super().trigger_and_grab(timeout)

    def close(self) -> None:
        super().close()
        self._files.cleanup()

    def _trigger(self) -> None:
        assert self._settings is not None
        counts = self._expose(self._settings)
        self._put(counts, BIT_DEPTHS[self._settings.pixel_format])
        if self._faults.due("latency"):
            time.sleep(_LATENCY)
        if self._faults.due("short_frame"):
            self._execute("ForceFailedBuffer")
        if self._faults.due("unplug"):
            self._execute("FirePnPCallback")
        if not self._faults.due("dropped_frame"):
            super()._trigger()

    def _execute(self, command: str) -> None:
        nodes = self._camera.GetNodeMap()
        if command == "ForceFailedBuffer":
            nodes.GetNode("ForceFailedBufferCount").Value = 1
        nodes.GetNode(command).Execute()

    def _put(self, counts: np.ndarray, bits: int) -> None:
        """Write the frame to both files of the folder, with the counts in the upper of 16 bits."""
        new, copy = Path(self._files.name, "new.tif"), Path(self._files.name, "copy.tif")
        tifffile.imwrite(new, np.asarray(counts, np.uint16) << (16 - bits))
        os.link(new, copy)
        os.replace(copy, self._folder / "0.tif")
        os.replace(new, self._folder / "1.tif")
