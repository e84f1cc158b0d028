"""A colour sensor by the commands, on the virtual rig."""

import pytest
import yaml
from commands.test_cli import call, one_line
from hardware.commands import tiny

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
