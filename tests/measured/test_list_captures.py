import numpy as np
import pytest

from thincam_jax.measured.raw import CaptureFileError
from thincam_jax.measured.read import list_captures


def save(path, shape=(4, 6)):
    with path.open("wb") as file:  # numpy.save would add a suffix
        np.save(file, np.full(shape, 2000, np.uint16))


def test_captures_in_the_order_of_their_numbers(tmp_path):
    for name in ("b_10.npy", "b_9.NPY", "a_2_x.tif", "a_11.png", "a_2.tiff"):
        save(tmp_path / name)
    (tmp_path / "notes.txt").touch()
    (tmp_path / "._b_9.npy").touch()
    (tmp_path / "folder.png").mkdir()
    found = list_captures(str(tmp_path))
    names = ["a_2.tiff", "a_2_x.tif", "a_11.png", "b_9.NPY", "b_10.npy"]
    assert sorted(p.name for p in found) == sorted(names)
    numbered = [p.name for p in found]
    assert numbered.index("b_9.NPY") < numbered.index("b_10.npy")
    assert numbered.index("a_2.tiff") < numbered.index("a_11.png") < numbered.index("b_9.NPY")
    assert list_captures(tmp_path) == found


def refused(folder, message, *arguments):
    with pytest.raises(CaptureFileError, match=message) as caught:
        list_captures(folder, *arguments)
    assert "\n" not in str(caught.value)


def test_the_odd_one_out_is_named(tmp_path):
    for name in ("a.npy", "b.npy", "c.npy"):
        save(tmp_path / name)
    save(tmp_path / "a0.npy", (6, 4))
    refused(tmp_path, r"a0\.npy: has shape \(6, 4\), others, as .\.npy, have \(4, 6\)")
    save(tmp_path / "a0.npy", (4, 6, 3))
    refused(tmp_path, r"a0\.npy: has shape \(4, 6, 3\)")


def test_what_cannot_be_listed(tmp_path):
    refused(tmp_path / "absent", "cannot be read as a folder")
    refused(tmp_path, "holds no capture; give a folder of TIFF, PNG, NPY or raw files")
    save(tmp_path / "a.npy")
    refused(tmp_path / "a.npy", "cannot be read as a folder")
    refused(tmp_path, r"a\.npy: holds values up to 2000, above the 1023 of 10 bit", 10)
    (tmp_path / "b.png").write_bytes(b"\x89PNG")
    refused(tmp_path, r"b\.png: is empty or cut short")
