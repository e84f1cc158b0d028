"""Reading image files: round trips, and everything broken."""

import io
import logging
import struct
import sys
import tracemalloc
import warnings
import zlib

import numpy as np
import PIL.Image
import pytest
import tifffile
from imagecodecs import png_encode

from thincam_jax._core import memory
from thincam_jax.measured import Raw, read_image, read_pixel_map
from thincam_jax.measured.raw import CaptureFileError
from thincam_jax.measured.read import read_images

SHAPE = (7, 10)


def counts(dtype, *channels, seed=1):
    top = np.iinfo(dtype).max
    values = np.random.default_rng(seed).integers(0, top, (*SHAPE, *channels), endpoint=True)
    values.ravel()[:2] = 0, top
    return values.astype(dtype)


def write_tiff(path, pixels, **options):
    tifffile.imwrite(path, pixels, **{"photometric": "minisblack", **options})


def write_npy(path, pixels):
    np.save(path, pixels, allow_pickle=False)


def same(raw: Raw, pixels: np.ndarray, kind: str, bits: int | None):
    assert raw.pixels.dtype == pixels.dtype.newbyteorder("=")
    np.testing.assert_array_equal(raw.pixels, pixels)
    assert (raw.format, raw.bits) == (kind, bits)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [(), (3,)])
def test_counts_come_back_as_they_were(tmp_path, dtype, channels):
    pixels, bits = counts(dtype, *channels), 8 * np.dtype(dtype).itemsize
    colour = {"photometric": "rgb"} if channels else {}
    write_npy(tmp_path / "a.npy", pixels)
    write_tiff(tmp_path / "a.tif", pixels, **colour)
    (tmp_path / "a.png").write_bytes(png_encode(pixels))
    same(read_image(tmp_path / "a.npy"), pixels, "npy", bits)
    same(read_image(str(tmp_path / "a.tif")), pixels, "tiff", bits)
    same(read_image(tmp_path / "a.png"), pixels, "png", bits)


def dng(pixels, white):
    """The smallest file that is one: a TIFF of a mosaic with the tags of DNG 1.4."""
    identity = [part for value in np.eye(3, dtype=int).ravel() for part in (int(value), 1)]
    tags = [
        (50706, 1, 4, (1, 4, 0, 0), True),  # version
        (50708, 2, 0, "Test camera", True),
        (33421, 3, 2, (2, 2), True),
        (33422, 1, 4, (0, 1, 1, 2), True),  # RGGB
        (50721, 10, 9, identity, True),  # colour matrix
        (50714, 4, 1, 200, True),  # black level
        (50717, 4, 1, white, True),
        (50728, 5, 3, (1,) * 6, True),  # neutral
        (50778, 3, 1, 21, True),  # daylight
    ]
    stream = io.BytesIO()
    tifffile.imwrite(stream, pixels, photometric=32803, extratags=tags)
    return stream.getvalue()


def test_a_camera_s_raw_file_gives_its_mosaic(tmp_path, monkeypatch):
    """The counts as they are, black level and all, with the camera's bits."""
    pixels = np.random.default_rng(0).integers(190, 4096, (36, 52), dtype=np.uint16)
    (tmp_path / "a.DNG").write_bytes(dng(pixels, white=4095))
    same(read_image(tmp_path / "a.DNG"), pixels, "raw", 12)
    (tmp_path / "b.nef").write_bytes(dng(pixels, white=4095)[:2000])
    with pytest.raises(CaptureFileError, match=r"b\.nef: cannot be read as RAW .*damaged") as error:
        read_image(tmp_path / "b.nef")
    assert "\n" not in str(error.value)
    monkeypatch.setitem(sys.modules, "rawpy", None)  # as where it is not installed
    with pytest.raises(CaptureFileError, match=r"pip install 'thincam_jax\[raw\]', or save it as"):
        read_image(tmp_path / "a.DNG")


def test_colours_of_16_bit_in_png_need_more_decoders(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imagecodecs", None)  # as where it is not installed
    grey, colour = counts(np.uint16), counts(np.uint16, 3)
    (tmp_path / "a.png").write_bytes(png_encode(colour))
    refused(tmp_path / "a.png", r"pip install 'thincam_jax\[codecs\]', or save it as TIFF without")
    (tmp_path / "b.png").write_bytes(png_encode(grey))
    same(read_image(tmp_path / "b.png"), grey, "png", 16)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
@pytest.mark.parametrize("compression", [None, "lzw", "zlib"])
def test_tiff_of_any_byte_order(tmp_path, order, dtype, compression):
    for channels, photometric in (((), "minisblack"), ((3,), "rgb")):
        pixels = counts(np.uint8, *channels).astype(dtype)
        options = {"photometric": photometric, "byteorder": order, "compression": compression}
        write_tiff(tmp_path / "a.tif", pixels, **options)
        bits = 8 * pixels.dtype.itemsize if pixels.dtype.kind == "u" else None
        same(read_image(tmp_path / "a.tif"), pixels, "tiff", bits)


@pytest.mark.parametrize("compression", ["tiff_lzw", "tiff_adobe_deflate", "packbits", None])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_files_that_pillow_wrote(tmp_path, compression, dtype):
    pixels = counts(dtype)
    kind = "tiff" if compression else "png"
    path = tmp_path / f"a.{kind}"
    PIL.Image.fromarray(pixels).save(path, **({"compression": compression} if compression else {}))
    same(read_image(path), pixels, kind, 8 * pixels.dtype.itemsize)


def test_npy_of_other_byte_and_column_order(tmp_path):
    pixels = counts(np.uint16)
    write_npy(tmp_path / "a.npy", np.asfortranarray(pixels.astype(">u2")))
    same(read_image(tmp_path / "a.npy"), pixels, "npy", 16)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_floats_have_no_bit_depth(tmp_path, dtype):
    pixels = np.random.default_rng(2).normal(size=SHAPE).astype(dtype)
    write_npy(tmp_path / "a.npy", pixels)
    raw = read_image(tmp_path / "a.npy")
    same(raw, pixels, "npy", None)
    assert raw.full_scale == 1.0


def test_planes_one_after_the_other_become_channels_last(tmp_path):
    pixels = counts(np.uint16, 3)
    planes = np.moveaxis(pixels, -1, 0)
    write_tiff(tmp_path / "a.tif", planes, photometric="rgb", planarconfig="separate")
    same(read_image(tmp_path / "a.tif"), pixels, "tiff", 16)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [2, 4])
def test_opaque_alpha_is_left_out_and_a_transparent_one_refused(tmp_path, channels, dtype):
    pixels = counts(dtype, channels)
    path = tmp_path / "a.png"
    path.write_bytes(png_encode(pixels))
    refused(path, "transparent pixels")
    pixels[..., -1] = np.iinfo(dtype).max
    path.write_bytes(png_encode(pixels))
    np.testing.assert_array_equal(
        read_image(path).pixels, pixels[..., 0] if channels == 2 else pixels[..., :3]
    )


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_camera_bits_in_sixteen(tmp_path, bits):
    pixels = counts(np.uint16) >> (16 - bits)
    write_tiff(tmp_path / "a.tif", pixels)
    raw = read_image(tmp_path / "a.tif", bits=bits)
    same(raw, pixels, "tiff", bits)
    assert raw.full_scale == pixels.max()


def refused(path, message, **options):
    """One line that names the file, and nothing on the way from other libraries."""
    with warnings.catch_warnings(), pytest.raises(CaptureFileError, match=message) as caught:
        warnings.simplefilter("error")
        read_image(path, **options)
    text = str(caught.value)
    assert str(path) in text and "\n" not in text
    shown = None if caught.value.__suppress_context__ else caught.value.__context__
    assert caught.value.__cause__ is None and shown is None


WRONG_VALUES = [
    (np.zeros(SHAPE, bool), "holds bool values.*mask"),
    (np.zeros(SHAPE, np.complex64), "holds complex64 values.*magnitude"),
    (np.zeros(SHAPE, np.int16), "holds int16 values.*no sign"),
    (np.zeros((0, 5), np.uint8), r"is empty \(shape \(0, 5\)\)"),
    (np.zeros((2, 3, 4, 1), np.uint8), r"has shape \(2, 3, 4, 1\)"),
    (np.zeros((4, 6, 5), np.uint8), "5 channels, where 1 to 4"),
    (np.array([[1.0, -np.inf]]), "1 of 2 values are NaN or infinite"),
]


@pytest.mark.parametrize(("pixels", "message"), WRONG_VALUES)
def test_values_that_are_no_measurement(tmp_path, pixels, message):
    write_npy(tmp_path / "a.npy", pixels)
    refused(tmp_path / "a.npy", message)


def test_objects_are_not_unpickled(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[{}]], dtype=object), allow_pickle=True)
    refused(tmp_path / "a.npy", "holds object values")


def test_bit_depth_that_does_not_hold_the_values(tmp_path):
    path = tmp_path / "a.tif"
    write_tiff(path, counts(np.uint8))
    refused(path, "holds 8-bit data, announced as 12 bit", bits=12)
    write_tiff(path, counts(np.uint16) | 1)
    refused(path, "values up to 65535, above the 4095 of 12 bit; give the bit depth", bits=12)
    write_tiff(path, counts(np.uint16) & 0xFFF0)
    refused(path, "up to 65520, above.*multiples of 16.*divide by 16", bits=12)
    with pytest.raises(CaptureFileError, match=r"bits = 7: give a whole number from 8 to 16"):
        read_image(path, bits=7)


def test_paths_that_are_no_file(tmp_path):
    refused(tmp_path / "absent.tif", "does not exist")
    refused(tmp_path, "is a folder")
    (tmp_path / "empty.png").touch()
    refused(tmp_path / "empty.png", "is empty or cut short")
    (tmp_path / "text.png").write_text("not an image\n", encoding="utf-8")
    refused(tmp_path / "text.png", "is not an image that can be read")


def test_stacks_are_refused(tmp_path):
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as writer:
        for rows in (7, 8, 8):
            writer.write(np.zeros((rows, 9), np.uint8), photometric="minisblack")
    refused(path, "holds 3 images of different sizes")
    with pytest.raises(CaptureFileError, match="holds 3 images of different sizes"):
        read_images(path)
    write_tiff(path, np.zeros((2, 7, 9), np.uint8))
    refused(path, "holds 2 images; give one")
    first, second = read_images(path)
    assert first.pixels.shape == (7, 9) and second.name == f"{path}, image 2"
    frames = [PIL.Image.fromarray(counts(np.uint8, seed=n)) for n in (1, 2)]
    frames[0].save(tmp_path / "a.png", save_all=True, append_images=frames[1:])
    refused(tmp_path / "a.png", "is animated")


def whole_files(folder):
    """One of each kind: contents by name."""
    pixels = counts(np.uint16)
    write_npy(folder / "a.npy", pixels)
    write_tiff(folder / "head-first.tif", pixels)
    write_tiff(folder / "deflated.tif", pixels, compression="zlib", rowsperstrip=2)
    PIL.Image.fromarray(pixels).save(folder / "lzw.tif", compression="tiff_lzw")
    write_tiff(folder / "big-endian.tif", pixels, byteorder=">")
    (folder / "grey.png").write_bytes(png_encode(pixels))
    (folder / "colour.png").write_bytes(png_encode(counts(np.uint16, 3)))
    buffer = io.BytesIO()
    np.save(buffer, pixels.astype(float))
    (folder / "float.npy").write_bytes(buffer.getvalue())
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.mark.thorough
def test_file_cut_at_any_length_is_refused_in_one_line(tmp_path, caplog, capfd):
    caplog.set_level(logging.WARNING)
    for name, content in whole_files(tmp_path).items():
        path = tmp_path / name
        whole = read_image(path).pixels
        lengths = {0, 1, 4, 8, *range(9, len(content), max(1, len(content) // 60))}
        for length in sorted({*lengths, *range(len(content) - 20, len(content))}):
            path.write_bytes(content[:length])
            try:
                found = read_image(path).pixels
            except CaptureFileError as error:
                assert "\n" not in str(error) and str(path) in str(error)
            else:  # all but the last bytes of a TIFF, which say where a next image would be
                assert name.endswith("tif") and length >= len(content) - 4, (name, length)
                np.testing.assert_array_equal(found, whole)
    assert not caplog.records
    assert capfd.readouterr() == ("", "")


@pytest.mark.thorough
def test_changed_bytes_give_one_line_or_an_image(tmp_path, caplog, capfd):
    """A flipped byte may be a pixel; elsewhere it must not bring a traceback of a library."""
    generator = np.random.default_rng(3)
    for name, content in whole_files(tmp_path).items():
        path = tmp_path / name
        for _ in range(150):
            damaged = bytearray(content)
            damaged[generator.integers(len(content))] ^= 1 << generator.integers(8)
            path.write_bytes(damaged)
            try:
                read_image(path)
            except CaptureFileError as error:
                assert "\n" not in str(error)
            else:
                assert not name.endswith("png"), "checksums see every change of a PNG"
    assert not caplog.records
    assert capfd.readouterr() == ("", "")


def test_a_header_that_announces_terabytes_is_refused(tmp_path):
    write_npy(tmp_path / "a.npy", counts(np.uint16))
    content = (tmp_path / "a.npy").read_bytes()
    huge = content.replace(b"(7, 10), }            ", b"(7000000, 10000000), }")
    assert len(huge) == len(content) and huge != content
    (tmp_path / "a.npy").write_bytes(huge)
    refused(tmp_path / "a.npy", "is cut short: 140 of the 140000000000000 bytes")


BOMB = 400_000  # rows and columns: 320 GB at 16 bit


def test_decompression_bombs_are_refused_before_there_is_room_for_them(tmp_path):
    """A PNG and a compressed TIFF of valid structure whose headers announce terabytes."""
    content = bytearray(png_encode(counts(np.uint16, 3)))
    content[16:24] = struct.pack(">II", BOMB, BOMB)
    content[29:33] = struct.pack(">I", zlib.crc32(bytes(content[12:29])))
    (tmp_path / "a.png").write_bytes(content)
    write_tiff(tmp_path / "a.tif", counts(np.uint16), compression="zlib")
    with tifffile.TiffFile(tmp_path / "a.tif", mode="r+") as file:
        for name in ("ImageWidth", "ImageLength", "RowsPerStrip"):
            file.pages[0].aspage().tags[name].overwrite(BOMB)
    tracemalloc.start()
    refused(tmp_path / "a.png", f"announces {BOMB**2 * 6} bytes of pixels, more than its")
    refused(tmp_path / "a.tif", f"announces {BOMB**2 * 2} bytes of pixels, more than its")
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()


def test_an_image_larger_than_the_memory_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "available_bytes", lambda: 100)
    (tmp_path / "a.png").write_bytes(png_encode(counts(np.uint16, 3)))
    refused(tmp_path / "a.png", "its image needs about 420 bytes, 100 bytes are free")


def test_masks(tmp_path):
    mask = np.zeros(SHAPE, bool)
    mask[2, 3] = mask[6, 9] = True
    write_npy(tmp_path / "a.npy", mask)
    PIL.Image.fromarray(mask.astype(np.uint8) * 7).save(tmp_path / "a.png")
    for name in ("a.npy", "a.png"):
        found = read_pixel_map(tmp_path / name)
        assert found.dtype == bool
        np.testing.assert_array_equal(found, mask)
    write_npy(tmp_path / "a.npy", np.zeros((3, 4, 3), bool))
    with pytest.raises(CaptureFileError, match=r"give a map \(y, x\)"):
        read_pixel_map(tmp_path / "a.npy")


def test_colours_that_are_no_counts(tmp_path):
    grey = PIL.Image.fromarray(counts(np.uint8))
    grey.convert("P").save(tmp_path / "a.png")
    refused(tmp_path / "a.png", "stores a palette")
    grey.convert("1").save(tmp_path / "b.png")
    refused(tmp_path / "b.png", "has 1 bit a sample")
    write_tiff(tmp_path / "a.tif", counts(np.uint8), photometric="miniswhite")
    refused(tmp_path / "a.tif", "stores colours as MINISWHITE")
