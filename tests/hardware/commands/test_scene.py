"""Scenes and grey levels by the commands, on the virtual rig and without a display."""

import numpy as np
import pytest
import yaml
from commands.test_cli import call, called, one_line
from hardware.commands import tiny

from thincam_jax.hardware.displays.levels import GreyLevels

SCENE = yaml.safe_load(tiny.METHOD_B)
SCENE["camera"]["exposure"] = "5 ms"
SCENE["plan"] = {
    "kind": "scene",
    "exposures": ["5 ms", "50 ms"],
    "frames": 3,
    "dark_frames": 2,
    "betas": ["60 rad/mm^2"],
    "width": "1.44 mm",
}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return tiny.write(tmp_path_factory.mktemp("scene"), yaml.safe_dump(SCENE))


@pytest.mark.thorough
def test_the_table_of_grey_levels_of_a_linear_display(file):
    """Level by level, and as the display's option."""
    store, out = file.with_name("levels.zarr"), file.with_name("levels")
    asked = "plan={kind: grey_levels, frames: 2, betas: [60 rad/mm^2], width: 1.44 mm}"
    sets = ("--set", asked, "--set", "acquisition.exposure=auto")
    for args in (("capture", file, "--out", store, *sets), ("run", store, "--out", out)):
        called(*args)
    levels = GreyLevels.load(out / "grey_levels.json")
    assert np.abs(levels.table.astype(int) - np.arange(256)).max() <= 2
    assert levels.provenance["frames"] == 2
    table = f"display.options.grey_levels={out / 'grey_levels.json'}"
    again = call("capture", file, "--out", file.with_name("b.zarr"), *sets, "--set", table)
    assert "display.options.grey_levels: this plan measures it; drop it" in one_line(again)


@pytest.mark.parametrize(
    ("asked", "line"),
    [
        ("optics=null", "optics: a plan of kind scene needs optics"),
        ("plan.frames=1", "plan.frames: exposures are weighed by the noise of each"),
        ("display={driver: sdl}", "display.pitch: a plan of kind scene is shown on pixels"),
        ("plan.width=null", "plan.width: optics need betas and width of the mask"),
    ],
)
def test_files_that_do_not_fit(file, asked, line):
    assert line in one_line(call("capture", file, "--set", asked))
