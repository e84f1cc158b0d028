"""Image files that are refused before they are decoded: with parts missing, or too large."""

import io
import itertools
import os
import struct
import tracemalloc
import zlib

import numpy as np
import PIL.Image
import pytest
import tifffile

import thincam_jax as tc
from thincam_jax._core import image_files
from thincam_jax.commands.config_file import ConfigError, read_raw
from thincam_jax.hardware.displays.levels import PhaseLevels
from thincam_jax.learn.checkpoint import CheckpointError, read_description
from thincam_jax.measured import read_image
from thincam_jax.measured.raw import CaptureFileError
from thincam_jax.measured.read import NonlinearWarning
from thincam_jax.measured.sensor import SensorCalibration

SHAPE = (21, 34)
GREY = np.random.default_rng(0).integers(1, 255, SHAPE).astype(np.uint8)
COLOUR = np.random.default_rng(1).integers(1, 255, (*SHAPE, 3)).astype(np.uint8)
pytestmark = pytest.mark.filterwarnings("ignore::thincam_jax.measured.read.NonlinearWarning")


def saved(pixels, kind, **options):
    stream = io.BytesIO()
    image = pixels if isinstance(pixels, PIL.Image.Image) else PIL.Image.fromarray(pixels)
    image.save(stream, kind, **options)
    return stream.getvalue()


def tiff(pixels, **options):
    stream = io.BytesIO()
    tifffile.imwrite(stream, pixels, photometric="minisblack", **options)
    return stream.getvalue()


def chunk(kind, body):
    checksum = struct.pack(">I", zlib.crc32(kind + body))
    return struct.pack(">I", len(body)) + kind + body + checksum


def png(rows, header, shape=SHAPE, end=None):
    """Of unpacked rows with their filters; `end`: bytes of the packed ones that are left out."""
    begin = chunk(b"IHDR", struct.pack(">II", *shape[::-1]) + header)
    packed = zlib.compress(rows)[:end]
    middle = len(packed) // 2
    parts = chunk(b"IDAT", packed[:middle]) + chunk(b"IDAT", packed[middle:])
    return b"\x89PNG\r\n\x1a\n" + begin + parts + chunk(b"IEND", b"")


def rows_of(pixels):
    return b"".join(b"\0" + row.tobytes() for row in pixels)


EIGHT_BIT = bytes([8, 0, 0, 0, 0])


def interlaced(pixels):
    steps = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4))
    parts = (pixels[y::dy, x::dx] for x, y, dx, dy in (*steps, (1, 0, 2, 2), (0, 1, 1, 2)))
    return png(b"".join(rows_of(part) for part in parts if part.size), bytes([8, 0, 0, 0, 1]))


def with_tag(content, name, change):
    """A TIFF whose tag has other values."""
    stream = io.BytesIO(content)
    with tifffile.TiffFile(stream) as file:
        tag = file.pages[0].aspage().tags[name]
        value, place = tag.value, tag.valueoffset
        kind = {3: "H", 4: "I"}[int(tag.dtype)]
    values = struct.pack(f"<{len(value)}{kind}", *change(list(value)))
    return content[:place] + values + content[place + len(values) :]


def without_last_part(content, name):
    return with_tag(content, name, lambda values: [*values[:-1], 0])


def read_both(path):
    """The line with which both readers refuse a file."""
    lines = []
    for read, error in ((tc.load_image, ValueError), (read_image, CaptureFileError)):
        with pytest.raises(error) as caught:
            read(path)
        lines.append(str(caught.value))
        assert str(path) in lines[-1] and "\n" not in lines[-1]
    return lines


PACKED = {"compression": "zlib", "rowsperstrip": 4}
JPEG_STRIPS = {"compression": "jpeg", "rowsperstrip": 16}
HALF = {
    "rows.png": png(rows_of(GREY[:10]), EIGHT_BIT),
    "more.png": png(rows_of(np.concatenate([GREY, GREY])), EIGHT_BIT),
    "packed.png": png(rows_of(GREY), EIGHT_BIT, end=-5),
    "checksum.png": (lambda c: c[:200] + bytes([c[200] ^ 4]) + c[201:])(saved(GREY, "PNG")),
    "open.png": saved(GREY, "PNG")[:-12],
    "baseline.jpg": saved(COLOUR, "JPEG")[:-300] + b"\xff\xd9",
    "progressive.jpg": saved(COLOUR, "JPEG", progressive=True)[:-300] + b"\xff\xd9",
    "restarts.jpg": saved(COLOUR, "JPEG", restart_marker_rows=1)[:-300] + b"\xff\xd9",
    "open.jpg": saved(COLOUR, "JPEG")[:-2],
    "zeros.jpg": (lambda c: c[:-300] + bytes(300))(saved(COLOUR, "JPEG")),
    "packed.tif": without_last_part(tiff(GREY, **PACKED), "StripOffsets"),
    "plain.tif": without_last_part(tiff(GREY, rowsperstrip=4), "StripOffsets"),
    "jpeg.tif": with_tag(
        tiff(GREY, **JPEG_STRIPS), "StripByteCounts", lambda counts: [n - 9 for n in counts]
    ),
}


@pytest.mark.parametrize("name", HALF)
def test_files_with_parts_missing_are_refused(tmp_path, name):
    (tmp_path / name).write_bytes(HALF[name])
    read_both(tmp_path / name)


WHOLE = {
    "a.png": (png(rows_of(GREY), EIGHT_BIT), GREY),
    "interlaced.png": (interlaced(GREY), GREY),
    "colour.png": (saved(COLOUR, "PNG"), COLOUR),
    "lzw.tif": (tiff(GREY, compression="lzw", predictor=True, rowsperstrip=4), GREY),
    "tiles.tif": (tiff(GREY, compression="zlib", tile=(16, 16)), GREY),
}


@pytest.mark.parametrize("name", WHOLE)
def test_whole_files_are_read(tmp_path, name):
    content, pixels = WHOLE[name]
    (tmp_path / name).write_bytes(content)
    np.testing.assert_array_equal(read_image(tmp_path / name).pixels, pixels)
    np.testing.assert_array_equal(tc.load_image(tmp_path / name, linear=True), pixels / 255)


def test_whole_lossy_files_are_read(tmp_path):
    smooth = np.add.outer(np.arange(48.0), np.arange(64.0)).astype(np.uint8)
    options = ({}, {"progressive": True}, {"restart_marker_rows": 1}, {"quality": 5})
    for number, given in enumerate(options):
        path = tmp_path / f"{number}.jpg"
        path.write_bytes(saved(smooth, "JPEG", **given) + b"a preview behind its end")
        with pytest.warns(NonlinearWarning):
            assert np.abs(read_image(path).pixels.astype(float) - smooth).max() < 40
    path = tmp_path / "a.tif"
    path.write_bytes(tiff(smooth, **JPEG_STRIPS))
    assert np.abs(read_image(path).pixels.astype(float) - smooth).max() < 40


def test_a_jpeg_is_decoded_twice(tmp_path, monkeypatch):
    """Once as it is, and once with more data, which tell whether it was whole."""
    (tmp_path / "a.jpg").write_bytes(saved(COLOUR, "JPEG"))
    decoder, made = PIL.Image._getdecoder, []

    def counted(mode, *rest):
        made.append(mode)
        return decoder(mode, *rest)

    monkeypatch.setattr(PIL.Image, "_getdecoder", counted)
    with pytest.warns(NonlinearWarning):
        read_image(tmp_path / "a.jpg")
    assert made == ["RGB"] * 2
    tc.load_image(tmp_path / "a.jpg")
    assert made == ["RGB"] * 4


def test_packed_images_have_a_largest_size(tmp_path, monkeypatch):
    monkeypatch.setattr(image_files, "_MOST_PIXELS", GREY.size - 1)
    flat = np.zeros(SHAPE, np.uint8)
    for name, content in (("a.png", saved(flat, "PNG")), ("a.tif", tiff(flat, compression="zlib"))):
        (tmp_path / name).write_bytes(content)
        for line in read_both(tmp_path / name):
            assert "announces 714 packed pixels, at most 713 are read; save it without" in line
    (tmp_path / "a.tif").write_bytes(tiff(flat))  # as the line says
    assert read_image(tmp_path / "a.tif").pixels.shape == SHAPE


def test_a_part_larger_than_its_tiff(tmp_path):
    """Of 34×21 pixels with a strip of 480×320, which is not decoded."""
    content, strip = tiff(GREY, **JPEG_STRIPS), saved(np.zeros((320, 480), np.uint8), "JPEG")
    place = len(content)
    content = with_tag(content, "StripOffsets", lambda places: [place] * len(places))
    content = with_tag(content, "StripByteCounts", lambda counts: [len(strip)] * len(counts))
    (tmp_path / "a.tif").write_bytes(content + strip)
    for line in read_both(tmp_path / "a.tif"):
        assert "a part of the TIFF is not of its image's size" in line


def test_packings_of_images_are_refused(tmp_path):
    (tmp_path / "a.tif").write_bytes(tiff(GREY, compression="png"))
    for line in read_both(tmp_path / "a.tif"):
        assert "is packed as PNG; save it with LZW or without compression" in line
    for given in ({"compression": "lzw"}, {}):  # as the line says
        (tmp_path / "a.tif").write_bytes(tiff(GREY, **given))
        np.testing.assert_array_equal(read_image(tmp_path / "a.tif").pixels, GREY)


def test_chains_of_images_and_of_scans(tmp_path, monkeypatch):
    monkeypatch.setattr(image_files, "_MOST_PAGES", 3)
    with tifffile.TiffWriter(tmp_path / "a.tif") as writer:
        for _ in range(4):
            writer.write(GREY, photometric="minisblack", metadata=None)
    assert "holds over 3 images; give several files" in read_both(tmp_path / "a.tif")[0]
    content = saved(COLOUR, "JPEG", progressive=True)
    last = content.rindex(b"\xff\xda")
    many = content[:last] + 101 * content[last:-2] + b"\xff\xd9"
    (tmp_path / "a.jpg").write_bytes(many)
    assert "scans, at most 100 are read; save it anew" in read_both(tmp_path / "a.jpg")[0]


def network(path):
    with pytest.raises(CheckpointError, match="is no file of a network"):
        read_description(path)


def table(path):
    with pytest.raises(ValueError, match="holds no table of phases: holds 3000000000 bytes, at"):
        PhaseLevels.load(path)


def calibration(path):
    with pytest.raises(ValueError, match="is no calibration of a sensor"):
        SensorCalibration.load(path)


def experiment(path):
    with pytest.raises(ConfigError, match="holds 3000000000 bytes, at most 131072 are read; give"):
        read_raw(path)


def npy(pixels):
    stream = io.BytesIO()
    np.save(stream, pixels)
    return stream.getvalue()


LARGE = {
    "a.png": (saved(GREY, "PNG"), read_both),
    "a.jpg": (saved(GREY, "JPEG"), read_both),
    "a.tif": (tiff(GREY), read_both),
    "none.png": (b"", read_both),
    "a.npy": (npy(GREY), lambda path: pytest.raises(CaptureFileError, read_image, path)),
    "a.dng": (b"II*\0", lambda path: pytest.raises(CaptureFileError, read_image, path)),
    "a.thincam": (b"{", network),
    "a.json": (b"{", table),
    "a.npz": (b"PK\3\4", calibration),
    "a.yaml": (b"name: a\n", experiment),
}


@pytest.mark.parametrize("name", LARGE)
def test_files_of_gigabytes_are_refused_before_they_are_read(tmp_path, name):
    content, refused = LARGE[name]
    (tmp_path / name).write_bytes(content)
    os.truncate(tmp_path / name, 3 * 10**9)  # which takes no room on the disk
    tracemalloc.start()
    try:
        refused(tmp_path / name)
        assert tracemalloc.get_traced_memory()[1] < 60e6
    finally:
        tracemalloc.stop()


def test_files_cut_and_ended_again_are_refused(tmp_path):
    """The end of a file is put behind any part of its data."""
    for content, end, begin in (
        (saved(COLOUR, "JPEG", quality=90), b"\xff\xd9", 640),
        (saved(COLOUR, "JPEG", quality=90, progressive=True), b"\xff\xd9", 640),
        (saved(COLOUR, "PNG"), chunk(b"IEND", b""), 50),
    ):
        path = tmp_path / "a"
        for length in itertools.chain(range(begin, len(content) - 40, 97)):
            path.write_bytes(content[:length] + end)
            read_both(path)
