"""Image files built byte by byte, without the libraries that the package reads them with."""

import functools
import struct
import zlib

import numpy as np

COLOUR_TYPES = {1: 0, 2: 4, 3: 2, 4: 6}


def png(pixels: np.ndarray, *, header: tuple[int, int] | None = None) -> bytes:
    """A PNG of uint8 or uint16 (y, x, channel); its rows use all five filters of the standard.

    `header` replaces bit depth and colour type.
    """
    rows, columns, channels = pixels.shape
    depth = 8 * pixels.dtype.itemsize
    step = channels * pixels.dtype.itemsize
    raw = pixels.astype(pixels.dtype.newbyteorder(">")).tobytes()
    width = columns * step
    previous, packed = bytes(width), b""
    for y in range(rows):
        row = raw[y * width : (y + 1) * width]
        packed += bytes([y % 5]) + _filtered(row, previous, step, y % 5)
        previous = row
    depth, colour = header or (depth, COLOUR_TYPES[channels])
    head = struct.pack(">IIBBBBB", columns, rows, depth, colour, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(packed))
        + chunk(b"IEND", b"")
    )


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _filtered(row: bytes, previous: bytes, step: int, kind: int) -> bytes:
    result = bytearray()
    for i, value in enumerate(row):
        left = row[i - step] if i >= step else 0
        above = previous[i]
        corner = previous[i - step] if i >= step else 0
        guess = left + above - corner
        # Of equal distances the first: left, above, corner.
        paeth = min((left, above, corner), key=functools.partial(_distance, guess))
        predicted = (0, left, above, (left + above) // 2, paeth)[kind]
        result.append((value - predicted) % 256)
    return bytes(result)


def _distance(guess: int, value: int) -> int:
    return abs(guess - value)


def tiff(pixels: np.ndarray, order: str = "<") -> bytes:
    """An uncompressed TIFF of one strip, uint or float, (y, x) or (y, x, channel)."""
    rows, columns = pixels.shape[:2]
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    data = pixels.astype(pixels.dtype.newbyteorder(order)).tobytes()
    bits, sample = 8 * pixels.dtype.itemsize, {"u": 1, "i": 2, "f": 3}[pixels.dtype.kind]
    entries = 10
    directory_size = 2 + 12 * entries + 4
    bits_at = 8 + directory_size
    data_at = bits_at + 8
    short, long = 3, 4

    def entry(tag: int, kind: int, value: int, count: int = 1) -> bytes:
        held = struct.pack(order + ("HH" if kind == short else "I"), *([value, 0][: 5 - kind]))
        return struct.pack(order + "HHI", tag, kind, count) + held

    bits_entry = entry(258, short, bits)
    if channels > 2:
        bits_entry = struct.pack(order + "HHII", 258, short, channels, bits_at)
    directory = struct.pack(order + "H", entries) + b"".join(
        [
            entry(256, long, columns),
            entry(257, long, rows),
            bits_entry,
            entry(259, short, 1),
            entry(262, short, 2 if channels == 3 else 1),
            entry(273, long, data_at),
            entry(277, short, channels),
            entry(278, long, rows),
            entry(279, long, len(data)),
            entry(339, short, sample),
        ]
    )
    magic = (b"II" if order == "<" else b"MM") + struct.pack(order + "HI", 42, 8)
    depths = struct.pack(order + "4H", *[bits] * channels, *[0] * (4 - channels))
    return magic + directory + struct.pack(order + "I", 0) + depths + data
