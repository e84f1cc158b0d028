"""Faults at random moments: each ends in the right error or is not noticed, never in a wrong frame.

The rules of an acquisition hold: a frame that did not come or came in parts is asked for again, a
camera that went is opened again, anything else would stop the run. Every frame says which exposure
it is, and has to be the one of its own trigger.
"""

import threading
from collections import Counter

import numpy as np
import pytest

from thincam_jax.hardware import CameraSettings, HardwareError
from thincam_jax.hardware.base import Disconnected, IncompleteFrame, ProtocolError, Timeout
from thincam_jax.hardware.cameras.usb3_vision.camera import Usb3VisionCamera

SETTINGS = CameraSettings(1e-3, pixel_format="Mono12")
RIGHT = {
    "latency": (),
    "stale_frame": (),
    "busy": (),
    "short_frame": (IncompleteFrame,),
    "dropped_frame": (Timeout,),
    "unplug": (Disconnected,),
    "nak": (ProtocolError,),
}


def campaign(device, scene, fault: str, times: int, seed: int) -> Counter:
    """Takes frames until the fault has happened so often; counts how each went."""
    random, counts = np.random.default_rng(seed), Counter()
    options = Usb3VisionCamera.Options(backend=device)
    camera, frames, order, calm = None, [], None, 0
    while device.faults.happened[fault] < times or calm > 0:
        if not calm and not device.faults.waiting() and not (order and order.is_alive()):
            # From another thread, anywhere within the next frame or while the camera is opened.
            order = threading.Timer(random.uniform(0, 0.004), device.faults.inject, (fault,))
            order.start()
            calm = int(random.integers(0, 4))  # frames before the next one
        try:
            if camera is None:
                camera = Usb3VisionCamera.open(options)
                camera.configure(SETTINGS)
            if random.random() < 0.5:
                camera.flush()
            before = scene.exposures
            frame = camera.trigger_and_grab(0.05)
        except HardwareError as error:
            assert isinstance(error, RIGHT[fault]), repr(error)
            counts[type(error).__name__] += 1
            if isinstance(error, Disconnected | ProtocolError):
                if camera is not None:
                    camera.close()
                camera = None
            continue
        number = scene.number_in(frame.pixels)
        assert number >= before, "a frame of before the trigger"
        assert number not in frames, "one frame twice"
        assert np.array_equal(frame.pixels, scene.frame(number, device.settings))
        frames.append(number)
        counts["frames"] += 1
        calm = max(calm - 1, 0)
    order.join()
    if camera is not None:
        camera.close()
    return counts


@pytest.mark.parametrize(
    "times", [5, pytest.param(100, marks=pytest.mark.thorough)], ids=lambda times: f"{times}_times"
)
@pytest.mark.parametrize("fault", RIGHT)
def test_a_fault_never_gives_a_wrong_frame(fault, times, device, scene):
    counts = campaign(device, scene, fault, times, seed=times)
    stopped = sum(counts[error.__name__] for error in RIGHT[fault])
    happened = device.faults.happened[fault]
    print(f"{fault}: {happened} injected, {happened - stopped} recovered, {stopped} stopped by "
          f"{'/'.join(e.__name__ for e in RIGHT[fault]) or 'nothing'}, "
          f"{counts['frames']} frames right")  # fmt: skip
    # One that strikes while the camera is being closed is not noticed.
    assert times * 0.5 <= stopped <= times if RIGHT[fault] else not stopped
