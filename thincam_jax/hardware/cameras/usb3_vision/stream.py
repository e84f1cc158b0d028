"""A USB3 Vision stream: leader, payload and trailer of each frame.

Functions without a device decode the data and raise `ValueError` for violations of the standard;
`FrameReader` reads frames with them. Numbers are little-endian:

    leader   u32 "U3VL"  u16 0  u16 size  u64 block id
             u16 0  u16 payload type  u64 timestamp (ns)  u32 pixel format
             u32 width  u32 height  u32 left  u32 top  u16 padding of a line  u16 0
    trailer  u32 "U3VT"  u16 0  u16 size  u64 block id  u16 status  u16 0  u64 valid bytes …
"""

import struct
from array import array
from dataclasses import dataclass
from time import monotonic

import numpy as np

from thincam_jax.hardware.base import IncompleteFrame, Region, Timeout
from thincam_jax.hardware.cameras.usb3_vision.gencp import SIRM_LENGTH, Sirm
from thincam_jax.hardware.cameras.usb3_vision.link import CameraMemory, UsbLink

LEADER = struct.Struct("<IHHQHHQIIIIIHH")
TRAILER = struct.Struct("<IHHQHHQ")
LEADER_MAGIC, TRAILER_MAGIC = 0x4C563355, 0x54563355
IMAGE = 0x0001  # payload type

# Names and numbers of the Pixel Format Naming Convention, with the bits of a count. Bits 16 … 23 of
# the number are the bits of a pixel on the wire.
_CODES = {  # of 8, 10, 12 and 16 bits, and of two pixels of 12 in three bytes
    "Mono": (0x01080001, 0x01100003, 0x01100005, 0x01100007, 0x010C0047),
    "BayerGR": (0x01080008, 0x0110000C, 0x01100010, 0x0110002E, 0x010C0057),
    "BayerRG": (0x01080009, 0x0110000D, 0x01100011, 0x0110002F, 0x010C0059),
    "BayerGB": (0x0108000A, 0x0110000E, 0x01100012, 0x01100030, 0x010C0055),
    "BayerBG": (0x0108000B, 0x0110000F, 0x01100013, 0x01100031, 0x010C0053),
}
PIXEL_FORMATS = {
    f"{colour}{bits}": (code, int(bits.rstrip("p")))
    for colour, codes in _CODES.items()
    for bits, code in zip(("8", "10", "12", "16", "12p"), codes, strict=True)
}

LARGEST_PAYLOAD = 256 << 20  # bytes; a frame of 11000² pixels of 16 bit
LARGEST_END = 64 << 10  # of a leader or trailer
TRANSFER = 1 << 20  # bytes of one read; the kernel holds 16 MiB for all of USB


@dataclass(frozen=True)
class Leader:
    """Leader of a frame: `time` in ns on the camera's clock, `pixel_format` a PFNC number."""

    block: int
    time: int
    pixel_format: int
    region: Region


def decode_leader(data: bytes | memoryview) -> Leader:
    """Decode a leader; `ValueError` for an invalid one."""
    if len(data) < LEADER.size:
        raise ValueError(f"{len(data)} bytes are too few for a leader of {LEADER.size}")
    magic, _, size, block, _, payload, time, code, width, height, left, top, padding, _ = (
        LEADER.unpack_from(data)
    )
    if magic != LEADER_MAGIC:
        raise ValueError(f"a leader begins with {LEADER_MAGIC:#010x}, this with {magic:#010x}")
    if not LEADER.size <= size <= len(data):
        raise ValueError(f"the leader announces {size} bytes and has {len(data)}")
    if payload != IMAGE or padding:
        raise ValueError(f"payload type {payload:#06x} with {padding} bytes after a line is no "
                         "plain image; switch chunk data off")  # fmt: skip
    return Leader(block, time, code, Region(top, left, height, width))


def decode_trailer(data: bytes | memoryview) -> tuple[int, int, int]:
    """Block id, status and number of valid payload bytes; `ValueError` for an invalid trailer."""
    if len(data) < TRAILER.size:
        raise ValueError(f"{len(data)} bytes are too few for a trailer of {TRAILER.size}")
    magic, _, size, block, status, _, valid = TRAILER.unpack_from(data)
    if magic != TRAILER_MAGIC:
        raise ValueError(f"a trailer begins with {TRAILER_MAGIC:#010x}, this with {magic:#010x}")
    if not TRAILER.size <= size <= len(data):
        raise ValueError(f"the trailer announces {size} bytes and has {len(data)}")
    return block, status, valid


def frame_bytes(pixel_format: str, region: Region) -> int:
    """Bytes of a frame on the wire."""
    wire_bits = PIXEL_FORMATS[pixel_format][0] >> 16 & 0xFF
    return (region.height * region.width * wire_bits + 7) // 8


def unpack(data: np.ndarray, pixel_format: str, shape: tuple[int, int]) -> np.ndarray:
    """Counts (y, x) from the bytes of a frame: uint8 for 8 bits, uint16 for all others.

    Mono12p and others of 12p hold two pixels in three bytes, low bits first: b₀ + 2⁸(b₁ mod 2⁴) and
    ⌊b₁/2⁴⌋ + 2⁴b₂.
    """
    if PIXEL_FORMATS[pixel_format][1] == 8:
        return data.reshape(shape)
    if not pixel_format.endswith("p"):
        return data.view("<u2").reshape(shape)
    count = shape[0] * shape[1]
    if count % 2:
        data = np.append(data, np.uint8(0))
    low, middle, high = (data[part::3].astype(np.uint16) for part in range(3))
    counts = np.empty(count + count % 2, np.uint16)
    counts[0::2] = low | (middle & 0xF) << 8
    counts[1::2] = middle >> 4 | high << 4
    return counts[:count].reshape(shape)


@dataclass(frozen=True)
class Transfers:
    """Bytes of a frame's transfers: leader, `parts` times `part`, a `last` part, and trailer."""

    leader: int
    part: int
    parts: int
    last: int
    trailer: int


def plan_transfers(registers: bytes, expected: int) -> Transfers:
    """Transfer sizes for frames of `expected` bytes, from the stream's registers.

    `ValueError` where they are inconsistent or exceed the limits.
    """
    (info,) = struct.unpack_from("<I", registers, Sirm.INFO)
    payload, leader, trailer = struct.unpack_from("<QII", registers, Sirm.REQUIRED_PAYLOAD)
    if (power := info >> 24) > 16:
        raise ValueError(f"it wants transfers in multiples of 2^{power} bytes, at most 2^16")
    step = 1 << power

    def aligned(size: int) -> int:
        return -(-size // step) * step

    for name, size, least, most in (
        ("leader", leader, LEADER.size, LARGEST_END),
        ("trailer", trailer, TRAILER.size, LARGEST_END),
        ("payload", payload, expected, LARGEST_PAYLOAD),
    ):
        if not least <= size <= most:
            raise ValueError(f"it announces a {name} of {size} bytes, allowed: {least} to {most}")
    part = min(TRANSFER, aligned(payload))
    parts = (payload - 1) // part
    return Transfers(
        aligned(leader), part, parts, aligned(payload - parts * part), aligned(trailer)
    )


class FrameReader:
    """Reader of whole frames: `prepare` after each configuration, `start` before, `stop` after.

    `prepare` allocates buffers for all frames; each frame is copied once, into its own array.
    """

    def __init__(self, link: UsbLink, control: CameraMemory, sirm: int):
        self._link, self._control, self._sirm = link, control, sirm

    def prepare(self, pixel_format: str, region: Region) -> None:
        """Configure the transfers of the following frames."""
        self._code, self._region = PIXEL_FORMATS[pixel_format][0], region
        self._expected = frame_bytes(pixel_format, region)
        try:
            plan = plan_transfers(self._control.read(self._sirm, SIRM_LENGTH), self._expected)
        except ValueError as error:
            raise self._link.broken("prepare the stream", str(error)) from error
        for register, value in (
            (Sirm.MAX_LEADER, plan.leader),
            (Sirm.PAYLOAD_SIZE, plan.part),
            (Sirm.PAYLOAD_COUNT, plan.parts),
            (Sirm.TRANSFER1_SIZE, plan.last),
            (Sirm.TRANSFER2_SIZE, 0),
            (Sirm.MAX_TRAILER, plan.trailer),
        ):
            self._control.write_number(self._sirm + register, value)
        self._leader, self._trailer = _buffer(plan.leader), _buffer(plan.trailer)
        # All full parts share a buffer.
        self._parts = [_buffer(plan.part)] * plan.parts + [_buffer(plan.last)]
        self._total = sum(len(part) for part in self._parts)

    def start(self) -> None:
        """Enable the stream."""
        self._control.write_number(self._sirm + Sirm.CONTROL, 1)

    def stop(self) -> None:
        """Disable the stream and discard frames in transfer."""
        self._control.write_number(self._sirm + Sirm.CONTROL, 0)
        scrap, deadline = _buffer(TRANSFER), monotonic() + 2.0
        while monotonic() < deadline:
            try:
                self._link.receive(self._link.stream_in, scrap, 0.001, "discard frames")
            except Timeout:
                break
        self._link.clear_halt(self._link.stream_in)

    def is_empty(self) -> bool:
        """Whether no frame is queued; else its leader is lost, so stop the stream then."""
        try:
            self._receive(self._leader, monotonic())
        except Timeout:
            return True
        return False

    def read(self, deadline: float) -> tuple[Leader, np.ndarray]:
        """Leader and bytes of the next frame, before `deadline` of `time.monotonic`.

        `Timeout` where none began, `IncompleteFrame` where part of it is missing, `ProtocolError`
        for a frame of another format or region.
        """
        received = self._receive(self._leader, deadline)
        leader = self._decoded(decode_leader, received)
        if leader.pixel_format != self._code or leader.region != self._region:
            raise self._link.broken(
                "read a frame", f"its leader is of {leader.pixel_format:#010x}, {leader.region}, "
                f"agreed were {self._code:#010x}, {self._region}"
            )  # fmt: skip
        payload, filled = np.empty(self._total, np.uint8), 0
        try:
            for part in self._parts:
                received = self._receive(part, deadline)
                payload[filled : filled + len(received)] = received
                filled += len(received)
                if len(received) < len(part):  # a short packet ends the payload
                    break
            if filled < self._expected:
                raise self._incomplete(f"{filled} of {self._expected} bytes came")
            block, status, valid = self._decoded(
                decode_trailer, self._receive(self._trailer, deadline)
            )
        except Timeout as error:
            raise self._incomplete(f"nothing came after {filled} bytes") from error
        if status or block != leader.block or not self._expected <= valid <= filled:
            raise self._incomplete(f"the trailer of block {block} after the leader of block "
                                   f"{leader.block} has status {status:#06x}, {valid} of "
                                   f"{self._expected} bytes valid")  # fmt: skip
        return leader, payload[: self._expected]

    def _receive(self, buffer: array, deadline: float) -> memoryview:
        count = self._link.receive(
            self._link.stream_in, buffer, deadline - monotonic(), "read a frame"
        )
        return memoryview(buffer)[:count]

    def _decoded(self, decode, received: memoryview):
        try:
            return decode(received)
        except ValueError as error:
            raise self._incomplete(str(error)) from error

    def _incomplete(self, cause: str) -> IncompleteFrame:
        return IncompleteFrame(self._link.name, "read a frame", cause, "trigger it again")


def _buffer(size: int) -> array:
    return array("B", bytes(size))
