"""Captures in other programs' files: what is read, and how others are brought in."""

import re
import sys
import zipfile

import imageio
import numpy as np
import PIL.Image
import pytest
import scipy.io

from thincam_jax import measured
from thincam_jax._core import memory
from thincam_jax.measured import read_image
from thincam_jax.measured.containers import unpack_raw
from thincam_jax.measured.raw import CaptureFileError

RNG = np.random.default_rng(0)
COUNTS = RNG.integers(0, 4096, (14, 22), dtype=np.uint16)
OTHER = RNG.random((9, 12))


def hdf5(path, **arrays):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", userblock_size=512 if path.suffix == ".mat" else 0) as file:
        for name, array in arrays.items():
            file[name] = array.T if path.suffix == ".mat" else array
    if path.suffix == ".mat":
        with open(path, "r+b") as file:
            file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM")


def fits(path, **arrays):
    library = pytest.importorskip("astropy.io.fits")
    parts = [library.PrimaryHDU()]
    parts += [library.ImageHDU(array, name=name) for name, array in arrays.items()]
    library.HDUList(parts).writeto(path)


WRITERS = {
    "a.npz": lambda path, **arrays: np.savez_compressed(path, **arrays),
    "a.mat": lambda path, **arrays: scipy.io.savemat(path, arrays, do_compression=True),
    "v73.mat": hdf5,
    "a.h5": hdf5,
    "a.fits": fits,
}


@pytest.mark.parametrize("name", WRITERS)
def test_the_only_array_or_that_of_a_key(tmp_path, name):
    path = tmp_path / name
    WRITERS[name](path, CAPTURE=COUNTS)
    found = read_image(path)
    np.testing.assert_array_equal(found.pixels, COUNTS)
    assert found.pixels.dtype == np.uint16
    path.unlink()
    WRITERS[name](path, CAPTURE=COUNTS, PSF=OTHER)
    np.testing.assert_array_equal(read_image(f"{path}:PSF").pixels, OTHER)
    with pytest.raises(CaptureFileError, match=r"holds CAPTURE, PSF; give one of them as FILE:KEY"):
        read_image(path)
    with pytest.raises(CaptureFileError, match=r"has no 'psf'; it holds CAPTURE, PSF$"):
        read_image(f"{path}:psf")


@pytest.mark.parametrize("name", WRITERS)
def test_an_image_beside_numbers_or_with_an_axis_of_one(tmp_path, name):
    path = tmp_path / name
    WRITERS[name](path, CAPTURE=COUNTS[None], TIME=np.full((1,) * 2, 0.02))
    key = ":CAPTURE" if name in ("a.npz", "a.h5", "v73.mat", "a.fits") else ""
    np.testing.assert_array_equal(read_image(f"{path}{key}").pixels, COUNTS)
    path.unlink()
    WRITERS[name](path, CAPTURE=np.stack([COUNTS] * 3))
    with pytest.raises(CaptureFileError, match=r"give one image, pixels\[0\], or colours as"):
        read_image(path)


@pytest.mark.parametrize(
    ("name", "start", "words"),
    [("a.fits.gz", b"\x1f\x8b\10", "gunzip a.fits.gz"), ("a.pgm", b"P2\n", "a PGM in text")],
)
def test_others_by_their_name(tmp_path, name, start, words):
    (tmp_path / name).write_bytes(start + bytes(40))
    with pytest.raises(CaptureFileError, match=words):
        read_image(tmp_path / name)


@pytest.mark.parametrize("name", ["a.npz", "a.mat", "a.h5", "v73.mat"])
def test_damaged_containers_give_one_line(tmp_path, name):
    WRITERS[name](tmp_path / name, CAPTURE=COUNTS)
    whole = (tmp_path / name).read_bytes()
    for part in (9, len(whole) // 3, len(whole) - 40):
        (tmp_path / name).write_bytes(whole[:part])
        with pytest.raises(CaptureFileError) as caught:
            read_image(tmp_path / name)
        assert "\n" not in str(caught.value)


def test_arrays_larger_than_the_memory_are_not_unpacked(tmp_path, monkeypatch):
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros((2000, 3000)))
    scipy.io.savemat(tmp_path / "a.mat", {"a": np.zeros((2000, 3000))}, do_compression=True)
    monkeypatch.setattr(memory, "available_bytes", lambda: 2**20)
    for name in ("a.npz", "a.mat"):
        with pytest.raises((CaptureFileError, MemoryError), match="its array"):
            read_image(tmp_path / name)


def test_no_code_is_run(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.array([[print, 1], [2, 3]], object))
    with pytest.raises(CaptureFileError, match="cannot be read as NPZ"):
        read_image(tmp_path / "a.npz")
    with zipfile.ZipFile(tmp_path / "b.npz", "w") as file:
        file.writestr("a.txt", "hello")
    with pytest.raises(CaptureFileError):
        read_image(tmp_path / "b.npz")


def test_hdf5_follows_no_links(tmp_path):
    h5py = pytest.importorskip("h5py")
    hdf5(tmp_path / "secret.h5", a=COUNTS)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["b"] = h5py.ExternalLink(str(tmp_path / "secret.h5"), "a")
        layout = h5py.VirtualLayout(COUNTS.shape, COUNTS.dtype)
        layout[:] = h5py.VirtualSource(str(tmp_path / "secret.h5"), "a", COUNTS.shape)
        file.create_virtual_dataset("c", layout)
    with pytest.raises(CaptureFileError, match="holds no array of numbers"):
        read_image(tmp_path / "a.h5")


def test_libraries_that_are_not_there(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    (tmp_path / "a.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(99))
    with pytest.raises(CaptureFileError, match=r"h5py: pip install 'thincam_jax\[containers\]'"):
        read_image(tmp_path / "a.h5")


@pytest.mark.parametrize(("largest", "bits"), [(255, 8), (1023, 10), (4095, 12), (65535, 16)])
def test_pgm_and_ppm(tmp_path, largest, bits):
    for channels, kind in (((), b"P5"), ((3,), b"P6")):
        pixels = RNG.integers(0, largest, (7, 10, *channels), endpoint=True)
        stored = pixels.astype(">u2" if largest > 255 else np.uint8)
        head = kind + b"\n# a comment\n10 7\n%d\n" % largest
        (tmp_path / "a.pgm").write_bytes(head + stored.tobytes())
        found = read_image(tmp_path / "a.pgm")
        np.testing.assert_array_equal(found.pixels, pixels)
        assert found.bits == bits
        (tmp_path / "b.pgm").write_bytes(head + stored.tobytes()[:-1])
        with pytest.raises(CaptureFileError, match="is damaged: .* bytes are no"):
            read_image(tmp_path / "b.pgm")


def packed(counts, bits, padding):
    """By the definition, pixel by pixel."""
    rows = bytearray()
    for row in counts.tolist():
        if bits == 10:
            for four in zip(*[iter(row)] * 4, strict=True):
                rows += bytes(c >> 2 for c in four)
                rows.append(sum((c & 3) << (2 * n) for n, c in enumerate(four)))
        else:
            for one, two in zip(*[iter(row)] * 2, strict=True):
                rows += bytes((one >> 4, two >> 4, (one & 15) | (two & 15) << 4))
        rows += bytes(padding)
    return bytes(rows)


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
@pytest.mark.parametrize("padding", [0, 7])
def test_frames_without_a_header_by_the_name_that_the_refusal_gives(tmp_path, bits, padding):
    counts = RNG.integers(0, 2**bits, (6, 12), dtype=np.uint16)
    path = tmp_path / f"a.raw{bits}"
    plain = counts.astype("u1" if bits == 8 else "<u2")
    rows = [row.tobytes() + bytes(padding) for row in plain]
    path.write_bytes(packed(counts, bits, padding) if bits in (10, 12) else b"".join(rows))
    with pytest.raises(CaptureFileError, match="counts without their size") as caught:
        read_image(path)
    (given,) = re.findall(r"as (\S+),", str(caught.value))
    given = given.replace("ROWSxCOLUMNS", "6x12")
    found = read_image(tmp_path / given)
    np.testing.assert_array_equal(found.pixels, counts)
    assert found.bits == bits
    path.rename(tmp_path / "a.raw")
    np.testing.assert_array_equal(read_image(tmp_path / f"a.raw:6x12x{bits}").pixels, counts)
    if not padding:
        np.testing.assert_array_equal(read_image(tmp_path / "a.raw:6x12").pixels, counts)
    for wrong in ("6x40", f"7x12x{bits}", f"6x9999x{bits}"):
        with pytest.raises(CaptureFileError, match="bytes are no"):
            read_image(tmp_path / f"a.raw:{wrong}")
    with pytest.raises(CaptureFileError, match=r"b.raw: cannot be read \(No such file"):
        read_image(tmp_path / "b.raw:6x12")
    with pytest.raises(measured.MeasurementError, match="bits = 14; give 8, 10, 12 or 16"):
        unpack_raw(tmp_path / "a.raw", (6, 12), 14)


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_a_width_and_a_height_in_the_wrong_order(tmp_path, bits):
    """Rows of a smooth image are alike at its own width; those of noise at any."""
    y, x = np.indices((24, 32))
    smooth = ((2**bits - 1) * np.exp(-((y - 9) ** 2 + (x - 20) ** 2) / 60)).astype(np.uint16)
    noise = RNG.integers(0, 2**bits, (24, 32), dtype=np.uint16)
    path = tmp_path / f"a.raw{bits}"
    for image in (smooth, noise):
        plain = image.astype("u1" if bits == 8 else "<u2")
        path.write_bytes(packed(image, bits, 0) if bits in (10, 12) else plain.tobytes())
        np.testing.assert_array_equal(read_image(f"{path}:24x32").pixels, image)
        if image is smooth:
            with pytest.raises(CaptureFileError, match="give rows, then columns: 24x32"):
                read_image(f"{path}:32x24")
        else:
            assert read_image(f"{path}:32x24").pixels.shape == (32, 24)


@pytest.mark.parametrize("name", ["a.bmp", "a.gif", "a.webp"])
def test_others_are_refused_by_their_name_with_the_line_that_brings_them_in(tmp_path, name):
    image = PIL.Image.fromarray((COUNTS // 16).astype(np.uint8))
    image.save(tmp_path / name, lossless=True)
    kind = {"a.bmp": "a BMP", "a.gif": "a GIF", "a.webp": "a WebP"}[name]
    with pytest.raises(CaptureFileError, match=f"is {kind}; numpy.save") as caught:
        read_image(tmp_path / name)
    exec(str(caught.value).split("; ")[1], {"numpy": np, "imageio": imageio})
    found = read_image(tmp_path / "a.npy").pixels
    assert np.array_equal(found if found.ndim == 2 else found[..., 0], COUNTS // 16)


def test_films_are_named(tmp_path):
    for start, name in ((b"RIFF\0\0\0\0AVI LIST", "an AVI film"), (b"\0\0\0 ftypisom", "an MP4")):
        (tmp_path / "a.bin2").write_bytes(start)
        with pytest.raises(CaptureFileError, match=re.escape(name)) as caught:
            read_image(tmp_path / "a.bin2")
        assert "index=0)" in str(caught.value)
