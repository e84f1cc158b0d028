"""`thincam reconstruct --distances`: refocused with a PSF measured at each distance."""

import json

import numpy as np
import PIL.Image
import pytest
import scipy.ndimage
import tifffile
from commands.reconstruct import simulated
from commands.reconstruct.test_command import call, one_line

DISTANCES = (60.0, 80.0, 120.0)
ALIKE = ("--bits", 12, "--background", simulated.DARK, "--iterations", 60)


def enlarged(light, scale):
    middle = (np.array(light.shape) - 1) / 2
    return scipy.ndimage.affine_transform(
        light, np.full(2, 1 / scale), middle - middle / scale, order=1
    )


@pytest.fixture(scope="module")
def paths(tmp_path_factory):
    """A PSF for each distance, as files and as one, and a chequered disc at each end."""
    folder = tmp_path_factory.mktemp("files")
    psfs = [enlarged(simulated.psf(), 1 + 24 / t) for t in DISTANCES]
    (folder / "psfs").mkdir()
    stack = np.stack([simulated.counts(p, 3) for p in psfs]).astype(np.uint16)
    for distance, image in zip(DISTANCES, stack, strict=True):
        simulated.write_tiff(folder / "psfs" / f"at_{distance:g}mm.tif", image)
    tifffile.imwrite(folder / "psfs.tif", stack, photometric="minisblack")
    near, far = objects()
    light = simulated.capture(near[None], psfs[0]) + simulated.capture(far[None], psfs[2])
    capture = simulated.write_tiff(folder / "capture.tif", simulated.counts(light[0], 10))
    return {"folder": folder / "psfs", "stack": folder / "psfs.tif", "capture": capture}


def objects():
    rows, columns = np.indices(simulated.SHAPE)
    squares = (rows // 3 + columns // 3) % 2
    return [squares * (np.hypot(rows - 30, columns - c) < 12) for c in (22, 54)]


@pytest.mark.thorough
def test_depth_map_and_image_that_is_sharp_everywhere(paths, tmp_path):
    result = call(
        paths, tmp_path / "a.png", "--distances", "60mm, 80mm, 12cm", *ALIKE, psf="folder"
    )
    assert result.exit_code == 0, result.output
    assert "a.png: each part from the distance it is sharp at; a-sweep.png" in result.stdout
    distance = np.load(tmp_path / "a-depth.npy")
    near, far = objects()
    assert np.median(distance[near > 0]) == pytest.approx(60, abs=8)
    assert np.median(distance[far > 0]) == pytest.approx(120, abs=16)
    sharp, focused = np.load(tmp_path / "a.npy"), np.load(tmp_path / "a-60mm.npy")
    both = near + far
    assert simulated.correlation(sharp, both) > simulated.correlation(focused, both) + 0.05
    for name in ("a", "a-60mm", "a-80mm", "a-120mm", "a-sweep", "a-depth"):
        with PIL.Image.open(tmp_path / f"{name}.png") as shown:
            shown.verify()
    record = json.loads((tmp_path / "a.json").read_text("utf-8"))
    assert record["sources"]["distances_mm"] == [60, 80, 120]
    assert [name[-8:] for name in record["psfs"]] == ["60mm.tif", "80mm.tif", "20mm.tif"]


@pytest.mark.parametrize(
    ("distances", "said"),
    [
        ("60mm,80mm", "at least 3 distances"),
        ("60mm,80mm,100", "has no unit"),
        ("80mm,60mm,100mm", "give finite positive distances, increasing"),
        ("60mm,80mm,100mm,120mm", "holds 3 PSFs for 4 distances; give one for each, nearest first"),
    ],
)
def test_refusals(paths, tmp_path, distances, said):
    assert said in one_line(call(paths, tmp_path / "a.png", "--distances", distances, psf="stack"))
    assert not list(tmp_path.iterdir())
