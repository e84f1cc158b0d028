"""GenCP and the stream to the byte; slow and foreign answers, and faults of the wire."""

import threading
from collections import Counter

import numpy as np
import pytest

from helpers import quick
from thincam_jax.hardware import CameraSettings, HardwareError
from thincam_jax.hardware.base import Disconnected, IncompleteFrame, ProtocolError, Timeout
from thincam_jax.hardware.cameras.usb3_vision import gencp, link, stream
from thincam_jax.hardware.cameras.usb3_vision.camera import Usb3VisionCamera
from thincam_jax.hardware.cameras.usb3_vision.gencp import Command


def test_commands_to_the_byte():
    read = "55335643 0040 0008 0c00 0100 0400000000000000 0000 4000"
    assert gencp.read_command(0x0004, 64, 1) == bytes.fromhex(read)
    write = "55335643 0040 0208 0c00 0200 0411000000000000 01000000"
    assert gencp.write_command(0x1104, b"\1\0\0\0", 2) == bytes.fromhex(write)


def test_answers_from_the_byte():
    packet = gencp.decode(bytes.fromhex("55335643 0000 0108 0400 0100 efbeadde"))
    assert (packet.status, packet.command, packet.request) == (0, Command.READ_ACKNOWLEDGE, 1)
    assert packet.data == bytes.fromhex("efbeadde")
    waiting = gencp.decode(bytes.fromhex("55335643 0000 0508 0400 0100 0000 f401"))
    assert gencp.pending_time(waiting) == 0.5
    refused = gencp.decode(bytes.fromhex("55335643 0480 0308 0000 0100"))
    assert gencp.status_name(refused.status) == "0x8004 (write protect)"


@pytest.mark.parametrize(
    ("packet", "said"),
    [
        ("55335643 0000 0108", "too few"),
        ("55335644 0000 0108 0000 0100", "the prefix"),
        ("55335643 0000 0108 0400 0100 efbe", "announces 4 bytes of data and has 2"),
        ("55335643 0000 0108 0000 0100 efbe", "announces 0 bytes of data and has 2"),
    ],
)
def test_what_is_no_packet(packet, said):
    with pytest.raises(ValueError, match=said):
        gencp.decode(bytes.fromhex(packet))


def test_a_stream_to_the_byte():
    leader = (
        "5533564c 0000 3400 0700000000000000 0000 0100 00ca9a3b00000000"
        "05001001 40000000 30000000 08000000 04000000 0000 0000"
    )
    decoded = stream.decode_leader(bytes.fromhex(leader))
    assert (decoded.block, decoded.time, decoded.pixel_format) == (7, 10**9, 0x01100005)
    region = decoded.region
    assert (region.width, region.height, region.left, region.top) == (64, 48, 8, 4)
    trailer = "55335654 0000 2000 0700000000000000 01a1 0000 0018000000000000 30000000"
    assert stream.decode_trailer(bytes.fromhex(trailer)) == (7, 0xA101, 6144)


def test_packed_pixels_to_the_bit():
    """Two pixels in three bytes, low bits first; the last of an odd number ends in half a byte."""
    packed = np.frombuffer(bytes.fromhex("236145 bc0a"), np.uint8)
    assert stream.unpack(packed, "Mono12p", (1, 3)).tolist() == [[0x123, 0x456, 0xABC]]


def test_frames_in_several_transfers(monkeypatch, device, scene):
    """The last transfer is shorter, or the frame is a whole number of them."""
    for transfer in (1024, 1536, 4096):
        monkeypatch.setattr(stream, "TRANSFER", transfer)
        with Usb3VisionCamera.open(Usb3VisionCamera.Options(backend=device)) as camera:
            settings = camera.configure(CameraSettings(0.01))
            frame = camera.trigger_and_grab(1.0)
            assert np.array_equal(frame.pixels, scene.frame(scene.exposures - 1, settings))


def test_an_answer_to_someone_else_is_passed_over(device, camera):
    device._answers.append((0.0, gencp.answer(Command.READ_ACKNOWLEDGE, 9999, b"wrong")))
    assert camera._control.read(gencp.Abrm.SERIAL, 4) == b"0001"


def test_an_answer_to_another_command_is_an_error(device, camera):
    request = camera._control._request + 1
    device._answers.append((0.0, gencp.answer(Command.WRITE_ACKNOWLEDGE, request, bytes(4))))
    with pytest.raises(ProtocolError, match="0x0803 instead of 0x0801"):
        camera._control.read(gencp.Abrm.SERIAL, 4)


@pytest.mark.parametrize("way", ["silent", "busy", "pending"])
def test_no_answer_is_waited_for_endlessly(monkeypatch, way, device, camera):
    monkeypatch.setattr(link, "LONGEST_ANSWER", 0.05)
    if way == "busy":
        device.faults.inject("busy", 10**6)
    elif way == "silent":
        device._command = lambda packet: None
    else:
        device._command = lambda packet: device._answers.extend(
            (0.0, gencp.answer(Command.PENDING, gencp.decode(packet).request, b"\0\0\xff\xff"))
            for _ in range(3)
        )
    with pytest.raises(Timeout):
        camera._control.read(gencp.Abrm.SERIAL, 4)


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


@pytest.mark.parametrize("times", quick([5, 100], 0))
@pytest.mark.parametrize("fault", RIGHT)
def test_a_fault_never_gives_a_wrong_frame(fault, times, device, scene):
    counts = campaign(device, scene, fault, times, seed=times)
    stopped = sum(counts[error.__name__] for error in RIGHT[fault])
    # One that strikes while the camera is being closed is not noticed.
    assert times * 0.5 <= stopped <= times if RIGHT[fault] else not stopped
