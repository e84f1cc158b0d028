"""Bytes that no camera should send, for the parsers and for the client as a whole.

    python fuzz.py parsers 1000000
    python fuzz.py client 5000
    python fuzz.py xml 5000

A process of its own, without the checks of types that slow the tests down a hundredfold; whoever
starts it bounds its time. It prints how many inputs were taken and refused, and by how many MiB it
grew.
"""

import random
import re
import struct
import sys
from pathlib import Path

import numpy as np

from thincam_jax.hardware import CameraSettings, HardwareError
from thincam_jax.hardware.base import Region
from thincam_jax.hardware.cameras.usb3_vision import gencp, link, stream
from thincam_jax.hardware.cameras.usb3_vision.camera import Usb3VisionCamera
from thincam_jax.hardware.virtual.usb3_vision import VirtualUsb3Vision

LEADER = stream.LEADER.pack(
    stream.LEADER_MAGIC, 0, 52, 7, 0, stream.IMAGE, 10**9, 0x01100005, 64, 48, 0, 0, 0, 0
)
TRAILER = stream.TRAILER.pack(stream.TRAILER_MAGIC, 0, 32, 7, 0, 0, 6144) + bytes(4)
REGISTERS = struct.pack("<IIQII", 10 << 24, 1, 6144, 52, 32) + bytes(24)
PARSERS = (
    (gencp.decode, gencp.answer(gencp.Command.READ_ACKNOWLEDGE, 5, bytes(16))),
    (gencp.decode, gencp.write_command(0x2000, bytes(8), 6)),
    (
        lambda data: gencp.pending_time(gencp.decode(data)),
        gencp.answer(gencp.Command.PENDING, 5, struct.pack("<HH", 0, 40)),
    ),
    (stream.decode_leader, LEADER),
    (stream.decode_trailer, TRAILER),
    (lambda data: stream.plan_transfers(data.ljust(48, b"\0"), 6144), REGISTERS),
)


def mutated(chance: random.Random, sample: bytes) -> bytes:
    """The sample with bytes changed, cut off or added, or nothing of it at all."""
    kind = chance.random()
    if kind < 0.2:
        return chance.randbytes(chance.randrange(80))
    data = bytearray(sample)
    for _ in range(chance.randrange(1, 4)):
        place = chance.randrange(len(data))
        size = chance.choice((1, 1, 2, 4, 8))
        value = chance.choice((bytes(8), b"\xff" * 8, chance.randbytes(8)))
        data[place : place + size] = value[:size]
    return bytes(data[: chance.randrange(len(data) + 1)] if kind < 0.4 else data)


def parsers(count: int) -> tuple[int, int]:
    """Each parser returns what keeps its limits, or raises ValueError."""
    chance, refused = random.Random(count), 0
    for turn in range(count):
        parse, sample = PARSERS[turn % len(PARSERS)]
        try:
            parsed = parse(mutated(chance, sample))
        except ValueError:
            refused += 1
            continue
        if isinstance(parsed, stream.Transfers):
            assert max(parsed.part, parsed.last) <= stream.TRANSFER + (1 << 16)
            assert parsed.parts * parsed.part + parsed.last <= stream.LARGEST_PAYLOAD + (1 << 16)
            assert max(parsed.leader, parsed.trailer) <= stream.LARGEST_END
    return count - refused, refused


class Mutating(VirtualUsb3Vision):
    """A camera on whose wire some of what it sends is changed."""

    chance, rate = random.Random(1), 0.0

    def bulk_read(self, dev_handle, ep, intf, buff, timeout):
        count = super().bulk_read(dev_handle, ep, intf, buff, timeout)
        if self.chance.random() < self.rate:
            data = mutated(self.chance, bytes(buff[: min(count, 100)]) or b"\0")
            if count > 100:  # of a long transfer the beginning is changed
                data = data.ljust(100, b"\0")[:100]
            else:
                count = min(len(data), len(buff))
            memoryview(buff)[: len(data[:count])] = data[:count]
        return count


def client(count: int) -> tuple[int, int]:
    """The client raises an error of the rig or returns a frame as agreed, and goes on after it."""
    link.LONGEST_ANSWER = 0.02
    device, camera, frames, errors = Mutating(expose, (48, 64)), None, 0, 0
    while frames + errors < count:
        try:
            device.rate = 0.002
            camera = camera or Usb3VisionCamera.open(Usb3VisionCamera.Options(backend=device))
            device.rate = 0.02
            if frames % 5 == 0:
                camera.configure(CameraSettings(1e-3, Region(0, 0, 16, 32), "Mono12"))
            camera.flush()
            frame = camera.trigger_and_grab(0.01)
            region = camera._settings.region
            assert region is not None and frame.pixels.shape == (region.height, region.width)
            frames += 1
        except HardwareError:
            errors += 1
            device.rate = 0.0
            if camera is not None and errors % 3 == 0:
                camera.close()
                camera = None
    return frames, errors


def expose(settings: CameraSettings) -> np.ndarray:
    assert settings.region is not None
    return np.zeros((settings.region.height, settings.region.width), np.uint16)


def xml(count: int) -> tuple[int, int]:
    """So it is with a camera whose XML holds names, values and lines where others should be."""
    link.LONGEST_ANSWER = 0.02
    chance, frames = random.Random(count), 0
    device = VirtualUsb3Vision(expose, (48, 64))
    sound = device._xml.decode()
    names = re.findall(r'Name="(\w+)"', sound)
    texts = [*re.findall(r">([^<>\n]+)<", sound), "-1", "1e999", "0xFFFFFFFFFFFFFFFF", "((", "1/0"]
    for _ in range(count):
        text = sound
        for _ in range(chance.randrange(1, 3)):
            kind, times = chance.random(), chance.choice((1, -1))
            if kind < 0.4:
                text = text.replace(chance.choice(texts), chance.choice(texts), times)
            elif kind < 0.6:
                text = text.replace(chance.choice(names), chance.choice(names), times)
            else:
                lines = text.splitlines()
                lines[chance.randrange(len(lines))] = chance.choice(lines)
                text = "\n".join(lines)
        device._xml = text.encode()
        device._power_on()
        try:
            with Usb3VisionCamera.open(Usb3VisionCamera.Options(backend=device)) as camera:
                camera.configure(CameraSettings(1e-3, Region(0, 0, 16, 32), "Mono12"))
                camera.trigger_and_grab(0.01)
            frames += 1
        except HardwareError:
            pass
    return frames, count - frames


def memory() -> int:
    """Most memory that this process has held, in MiB; getrusage would count its parent's, too."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) >> 10 for line in lines if line.startswith("VmHWM"))


if __name__ == "__main__":
    for what, count in zip(sys.argv[1::2], sys.argv[2::2], strict=True):
        before = memory()
        counts = {"parsers": parsers, "client": client, "xml": xml}[what](int(count))
        print(*counts, memory() - before)
