"""A colour sensor by the commands, on the virtual rig."""

import json

import numpy as np
import PIL.Image
import pytest
import yaml
from commands.pages import assert_says_its_result
from commands.test_cli import call, one_line
from hardware.commands import tiny

from thincam_jax.hardware.acquisition.read import Acquisition

COLOURS = yaml.safe_load(tiny.METHOD_B)
COLOURS["camera"] |= {
    "pixel_format": "BayerGB12",
    "region": {"top": 4, "left": 8, "height": 56, "width": 80},
}
del COLOURS["optics"]["wavelength"]
COLOURS["optics"]["colours"] = ["630 nm", "532 nm", "465 nm"]
COLOURS["targets"] = [{"name": "cat", "kind": "photograph", "image": "chelsea"}]


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # where held devices are noted
    return tiny.write(tmp_path, yaml.safe_dump(COLOURS))


@pytest.mark.thorough
def test_a_colour_image_of_mosaics_agrees_with_direct_simulation(file, tmp_path):
    """Frames with the colour of each pixel, and the image, within the noise."""
    store, out = tmp_path / "a.zarr", tmp_path / "out"
    for args in (("capture", file, "--out", store), ("run", store, "--out", out)):
        result = call(*args)
        assert result.exit_code == 0, result.output
    assert Acquisition.load(store).settings[0].bayer == "GBRG"
    found = json.loads((out / "metrics.json").read_text("utf-8"))
    agreement, scores = found["agreement"], found["psnr_db"]
    for residual, bias in zip(
        agreement["frame_residual_over_noise"], agreement["frame_bias_over_noise"], strict=True
    ):
        assert abs(residual - 1) < 0.04  # 56·80 pixels: 0.011
        assert abs(bias) < 0.15  # of the mean of two dark frames, and 0.015
    assert abs(scores["captured"] - scores["simulated"]) < 1.5
    assert all(scores[f"captured {colour}"] > 15 for colour in ("red", "green", "blue"))
    assert_says_its_result(out)
    for name in ("scene", "captured"):
        image = np.asarray(PIL.Image.open(out / f"images/{name}.png"), float)
        assert image.ndim == 3 and np.ptp(image.mean(axis=(0, 1))) > 10  # a brown cat


@pytest.mark.parametrize(
    ("asked", "line"),
    [
        ("camera.pixel_format=BayerRG11", "'BayerRG11' is unknown; choose one of 'Mono8', "),
        ("camera.pixel_format=Mono12", "optics.colours: Mono12 takes a wavelength and no colours"),
        ("optics.colours=null", "BayerGB12 takes colours: [red, green, blue] and no wavelength"),
        ("optics.wavelength=532 nm", "optics.wavelength: BayerGB12 takes colours: [red, "),
        ("optics.colours=[630 nm, 532 nm]", "optics.colours[2]: missing; the list needs this"),
        (
            "plan={kind: alignment, betas: [60 rad/mm^2], width: 1.44 mm, marks: [3, 3], "
            "spread: 60 mm, size: 4 mm}",
            "camera.pixel_format: a plan of kind alignment takes one colour; give a Mono format",
        ),
    ],
)
def test_files_that_do_not_fit(file, asked, line):
    assert line in one_line(call("capture", file, "--set", asked))
