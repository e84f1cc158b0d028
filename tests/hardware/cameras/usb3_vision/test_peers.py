"""The virtual camera as programs of others see it: what they receive is what was exposed.

They run unmodified, with umockdev's library in front of them; see usbfs.py.
"""

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hardware.cameras.usb3_vision.usbfs import PRELOAD, presented

from thincam_jax.hardware.base import Region

pytestmark = pytest.mark.skipif(not PRELOAD.exists(), reason="needs Debian's umockdev")

ARAVIS = """
import gi, sys
gi.require_version("Aravis", "0.8")
from gi.repository import Aravis
Aravis.update_device_list()
vendors = [Aravis.get_device_vendor(n) for n in range(Aravis.get_n_devices())]
camera = Aravis.Camera.new(Aravis.get_device_id(vendors.index("thincam_jax")))
camera.set_pixel_format_from_string("Mono12")
camera.set_region(8, 4, 32, 20)
camera.set_exposure_time(2000.0)
buffer = camera.acquisition(5000000)
assert buffer.get_status() == Aravis.BufferStatus.SUCCESS, buffer.get_status()
open(sys.argv[1], "wb").write(buffer.get_data())
"""

CAMELEON = """
import pycameleon, sys
(camera,) = pycameleon.enumerate_cameras()
camera.open()
camera.load_context_from_camera()
camera.write_enum_as_str("PixelFormat", "Mono12")
for name, value in (("Width", 32), ("Height", 20), ("OffsetX", 8), ("OffsetY", 4)):
    camera.write_integer(name, value)
camera.write_float("ExposureTime", 2000.0)
image, information = camera.receive_raw(camera.start_streaming(1))
open(sys.argv[1], "wb").write(image.tobytes())
camera.close()
"""

OURSELVES = """
import sys
from thincam_jax.hardware import CameraSettings, Region
from thincam_jax.hardware.cameras.usb3_vision import Usb3VisionCamera
with Usb3VisionCamera.open(Usb3VisionCamera.Options(serial="0001")) as camera:
    camera.configure(CameraSettings(2e-3, Region(4, 8, 20, 32), "Mono12"))
    for _ in range(3):
        camera.flush()
        frame = camera.trigger_and_grab(5.0)
    assert frame.number == 2
open(sys.argv[1], "wb").write(frame.pixels.tobytes())
"""

SYSTEM_PYTHON = "/usr/bin/python3"  # Debian's bindings are for Debian's Python


def has_aravis_bindings() -> bool:
    if not Path(SYSTEM_PYTHON).exists():
        return False
    asked = [SYSTEM_PYTHON, "-c", "import gi; gi.require_version('Aravis', '0.8')"]
    return subprocess.run(asked, capture_output=True).returncode == 0


@pytest.mark.parametrize(
    "script",
    [
        pytest.param(ARAVIS, marks=pytest.mark.thorough),
        pytest.param(CAMELEON, marks=pytest.mark.thorough),
        OURSELVES,
    ],
    ids=["aravis", "pycameleon", "libusb"],
)
def test_a_peer_receives_every_pixel(script, device, scene, tmp_path):
    """Two clients of others, and our own through libusb."""
    if script is ARAVIS and not has_aravis_bindings():
        pytest.skip("needs Debian's gir1.2-aravis-0.8 and python3-gi")
    if script is CAMELEON and not importlib.util.find_spec("pycameleon"):
        pytest.skip("needs pycameleon: pip install pycameleon")
    python = SYSTEM_PYTHON if script is ARAVIS else sys.executable
    with presented(device) as run:
        result = run(python, "-c", script, str(tmp_path / "frame"))
    assert result.returncode == 0, result.stdout
    received = np.fromfile(tmp_path / "frame", "<u2").reshape(20, 32)
    settings = device.settings
    assert (settings.region, settings.exposure) == (Region(4, 8, 20, 32), 0.002)
    exposed = scene.frame(scene.number_in(received), settings)
    assert np.array_equal(received, exposed)


@pytest.mark.thorough
@pytest.mark.skipif(not shutil.which("arv-test-0.8"), reason="needs Debian's aravis-tools")
@pytest.mark.parametrize("mode", ["sync", "async"])
def test_the_test_program_of_aravis_finds_no_fault(mode, device, tmp_path):
    settings = "[thincam_jax:Virtual camera]\nChunksSupport=false\nSensorSize=64;48\n"
    (tmp_path / "settings").write_text(settings, "utf-8")
    with presented(device) as run:
        result = run("arv-test-0.8", "-n", "thincam_jax*", "-s", mode,
                     "-c", str(tmp_path / "settings"))  # fmt: skip
    # How fast the frames come depends on what else this machine does.
    verdicts = [line for line in result.stdout.splitlines() if "FrameRate" not in line]
    assert sum("SUCCESS" in line for line in verdicts) == 12, result.stdout
    assert not any("FAILURE" in line for line in verdicts), result.stdout
