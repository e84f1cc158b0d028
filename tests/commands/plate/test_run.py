"""Designs of plates: what a file may say, and what `thincam design` leaves behind."""

import json
import re

import pytest
from typer.testing import CliRunner

from helpers import ROOT
from thincam_jax.commands.checked_config import load_as
from thincam_jax.commands.cli import app
from thincam_jax.commands.config_file import read_raw
from thincam_jax.commands.plate.config import PlateDesignConfig
from thincam_jax.commands.screen.config import HologramConfig

PATH = ROOT / "configs" / "sts_design.yaml"
SMALL = (
    "sensor.shape=[12, 14]",
    "sensor.pitch=160 um",
    "object.cells=[8, 8]",
    "search={starts: 1, samples: 4, steps: 2}",
    "focal_distances=[8 mm]",
    "plate.lens_distance=10 mm",
    "method={name: ridge, kind: ridge}",
    "targets=[{name: camera, kind: photograph, image: camera}]",
)


def test_the_shipped_file_is_read():
    config = load_as(PlateDesignConfig, PATH)
    assert config.plate.glass_thickness == (5.0, 5.0)  # one value stays
    assert config.plate.film_thickness == pytest.approx((0.008, 0.025))


@pytest.mark.parametrize(
    ("override", "complaint"),
    [
        ("plate.film_thickness=[25 um, 8 um]", r"film_thickness: .* give the lower limit first"),
        ("plate.lens_distance=10", r"lens_distance.*10 has no unit"),
        ("sensor.exposure=0.9", "parts of the light of white"),
        ("targets=[{name: a, kind: file, path: /none.png}]", "targets: .*none.png"),
    ],
)
def test_faults_are_told(override, complaint, tmp_path):
    asked = [part for text in (*SMALL, override) for part in ("--set", text)]
    done = CliRunner().invoke(app, ["design", str(PATH), "--out", str(tmp_path / "out"), *asked])
    assert done.exit_code != 0 and re.search(complaint, done.output.replace("\n", " "))


@pytest.mark.thorough
def test_a_design(tmp_path):
    """The plate found beats the default in expectation; its sections are those of a screen."""
    asked = [part for text in SMALL for part in ("--set", text)]
    out = tmp_path / "out"
    done = CliRunner().invoke(app, ["design", str(PATH), "--out", str(out), *asked])
    assert done.exit_code == 0, done.output
    design = json.loads((out / "design.json").read_text())
    default, found = (design["plates"][name] for name in ("default", "found"))
    assert found["error"] < default["error"] and len(design["front"]) == 1
    assert set(found["targets"]) == {"camera"}
    page = (out / "report.html").read_text("utf-8")
    assert page.count("data:image/png") == 3 and "None" not in page
    film = HologramConfig.model_validate(read_raw(out / "found.yaml")[0]["hologram"])
    assert film.thickness == pytest.approx(found["numbers"]["film_thickness"] * 1e-3)
