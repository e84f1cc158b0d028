"""GenCP packets and bootstrap registers, as USB3 Vision carries them over bulk endpoints.

Encoding and decoding only, without a device; an invalid packet raises `ValueError`. Numbers are
little-endian. A packet is a header of twelve bytes and its data:

    u32 prefix "U3VC"   u16 flags or status   u16 command   u16 length of data   u16 request id

From the GenCP standard 1.3 and the USB3 Vision standard 1.2.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum

HEADER = struct.Struct("<IHHHH")
PREFIX = 0x43563355  # "U3VC"
REQUEST_ACKNOWLEDGE = 0x4000
ADDRESSED_READ = struct.Struct("<QHH")  # address, reserved, length
ADDRESS = struct.Struct("<Q")
RESERVED_AND_NUMBER = struct.Struct("<HH")  # of a pending (ms) and of a write acknowledge (bytes)


class Command(IntEnum):
    READ = 0x0800
    READ_ACKNOWLEDGE = 0x0801
    WRITE = 0x0802
    WRITE_ACKNOWLEDGE = 0x0803
    PENDING = 0x0805  # the answer comes later


class Status(IntEnum):
    SUCCESS = 0x0000
    NOT_IMPLEMENTED = 0x8001
    INVALID_PARAMETER = 0x8002
    INVALID_ADDRESS = 0x8003
    WRITE_PROTECT = 0x8004
    BAD_ALIGNMENT = 0x8005
    ACCESS_DENIED = 0x8006
    BUSY = 0x8007
    MESSAGE_TIMEOUT = 0x800B
    INVALID_HEADER = 0x800E
    WRONG_CONFIGURATION = 0x800F
    GENERIC_ERROR = 0x8FFF
    STREAM_ENDPOINT_HALTED = 0xA002
    STREAM_SIZE_NOT_ALIGNED = 0xA003
    STREAM_REGISTERS_INCONSISTENT = 0xA004


def status_name(status: int) -> str:
    """Status in a message, such as "0x8004 (write protect)"."""
    names = {known.value: known.name.lower().replace("_", " ") for known in Status}
    return f"{status:#06x} ({names.get(status, 'unknown')})"


class Abrm(IntEnum):
    """Addresses of the registers of every GenCP device; texts are 64 bytes long."""

    VERSION = 0x0000
    MANUFACTURER = 0x0004
    MODEL = 0x0044
    DEVICE_VERSION = 0x00C4
    SERIAL = 0x0144
    CAPABILITY = 0x01C4  # u64
    RESPONSE_TIME = 0x01CC  # ms
    MANIFEST = 0x01D0  # u64 address
    SBRM = 0x01D8  # u64 address
    TIMESTAMP = 0x01F0  # u64, ns
    TIMESTAMP_LATCH = 0x01F8


TEXT_LENGTH = 64
HAS_TIMESTAMP = 1 << 3  # of Abrm.CAPABILITY
HAS_SBRM = 1 << 9


class Sbrm(IntEnum):
    """Registers of USB3 Vision, from the address that Abrm.SBRM holds."""

    VERSION = 0x00
    CAPABILITY = 0x04  # u64
    MAX_COMMAND = 0x14  # bytes
    MAX_ACKNOWLEDGE = 0x18
    SIRM = 0x20  # u64 address
    SIRM_LENGTH = 0x28
    CURRENT_SPEED = 0x40


HAS_SIRM = 1  # of Sbrm.CAPABILITY


class Sirm(IntEnum):
    """Registers of the stream, from the address that Sbrm.SIRM holds; sizes in bytes."""

    INFO = 0x00  # bits 24 … 31: sizes are multiples of 2 to this power
    CONTROL = 0x04  # bit 0: streaming
    REQUIRED_PAYLOAD = 0x08  # u64
    REQUIRED_LEADER = 0x10
    REQUIRED_TRAILER = 0x14
    MAX_LEADER = 0x18
    PAYLOAD_SIZE = 0x1C
    PAYLOAD_COUNT = 0x20
    TRANSFER1_SIZE = 0x24
    TRANSFER2_SIZE = 0x28
    MAX_TRAILER = 0x2C


SIRM_LENGTH = 0x30
MANIFEST_ENTRY = struct.Struct("<IIQQ")  # version, schema, address, size; 64 bytes with the rest
ZIPPED = 1  # bits 10 … 15 of an entry's schema: 0 plain, 1 zip


@dataclass(frozen=True)
class Packet:
    """A decoded packet; a command has flags where an answer has its `status`."""

    status: int
    command: int
    request: int
    data: bytes


def read_command(address: int, length: int, request: int) -> bytes:
    """READMEM: `length` bytes from `address`."""
    data = ADDRESSED_READ.pack(address, 0, length)
    return HEADER.pack(PREFIX, REQUEST_ACKNOWLEDGE, Command.READ, len(data), request) + data


def write_command(address: int, data: bytes, request: int) -> bytes:
    """WRITEMEM: `data` to `address`."""
    data = ADDRESS.pack(address) + data
    return HEADER.pack(PREFIX, REQUEST_ACKNOWLEDGE, Command.WRITE, len(data), request) + data


def answer(command: int, request: int, data: bytes = b"", status: int = 0) -> bytes:
    """An acknowledge, as a device sends it."""
    return HEADER.pack(PREFIX, status, command, len(data), request) + data


def decode(packet: bytes | bytearray | memoryview) -> Packet:
    """Decode a complete packet; `ValueError` for an invalid one."""
    if len(packet) < HEADER.size:
        raise ValueError(f"{len(packet)} bytes are too few for a header of {HEADER.size}")
    prefix, flags, command, length, request = HEADER.unpack_from(packet)
    if prefix != PREFIX:
        raise ValueError(f"the prefix is {prefix:#010x} instead of {PREFIX:#010x}")
    if length != len(packet) - HEADER.size:
        raise ValueError(f"it announces {length} bytes of data and has {len(packet) - HEADER.size}")
    return Packet(flags, command, request, bytes(packet[HEADER.size :]))


def pending_time(packet: Packet) -> float:
    """Waiting time, s, that a pending acknowledge requests."""
    if len(packet.data) != RESERVED_AND_NUMBER.size:
        raise ValueError(f"a pending acknowledge has {len(packet.data)} bytes of data instead of 4")
    return RESERVED_AND_NUMBER.unpack(packet.data)[1] * 1e-3


def text(data: bytes) -> str:
    """Text of a register, up to the first zero."""
    return data.split(b"\0", 1)[0].decode("utf-8", "replace")
