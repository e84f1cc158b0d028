"""Plates for shops: read back by another program, and compared with the grey mask."""

import json

import klayout.db
import numpy as np
import pytest
from commands.study import tiny
from commands.test_cli import call, called, one_line

import thincam_jax as tc
from thincam_jax.lensless.masks.halftone import halftone
from thincam_jax.units import nm, um


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return tiny.write(tmp_path_factory.mktemp("plate"))


@pytest.mark.thorough
@pytest.mark.parametrize("density", ["amplitude", "irradiance"])
def test_cells_are_those_of_the_mask_and_their_psf_is_found(file, density, tmp_path):
    """The PSF's error against one computed here, on the sensor of the file."""
    out = tmp_path / "plate.gds"
    options = ("--halftone", f"10 um, {density}", "--shot", "1", "--json")
    result = called("plate", file, "--out", out, *options)
    found = {}
    for line in result.stdout.splitlines():
        found |= json.loads(line)
    grey = tc.FresnelZoneAperture(25.0, np.pi / 2, width=2.0)
    plate = halftone(grey, 10 * um, density)
    layout = klayout.db.Layout()
    layout.read(str(out))
    region = klayout.db.Region(layout.top_cell().begin_shapes_rec(layout.layer(1, 0)))
    region.merge()
    cells = np.asarray(plate.amplitude)
    assert region.area() * 1e-12 == pytest.approx(cells.sum() * (10 * um) ** 2, rel=1e-9)
    sensor, light = tc.Sensor((48, 64), 40 * um), {"wavelength": 500 * nm, "object_distance": 100.0}
    finer = tc.PsfMethod("separable", nodes=144)
    first, second = (
        np.asarray(tc.psf(tc.LenslessCamera(one, sensor, 3.0), model=finer, **light))
        for one in (grey, plate)
    )
    error = np.linalg.norm(second - first) / np.linalg.norm(first)
    assert found["image_db"] > 5
    assert found["psf_error"] == pytest.approx(error, rel=1e-3) and 0.05 < error < 0.6


def test_a_grey_table(file, tmp_path):
    called("plate", file, "--out", tmp_path / "plate.tif", "--pixel", "10 um")
    record = json.loads((tmp_path / "plate.json").read_text("utf-8"))
    assert record["shape"] == [200, 200] and record["pixel_mm"] == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--out", "a.dxf"), "--out a.dxf: give .gds, or .png or .tif for a grey table"),
        (("--out", "a.tif"), "--pixel: a grey table needs it, such as 1um"),
        (("--out", "a.gds", "--pixel", "1um"), "--pixel: a layout has none"),
        (("--out", "a.gds", "--halftone", "4"), "--halftone: "),
        (("--out", "a.gds", "--halftone", "7um"), "not a whole number of cells"),
        (("--out", "a.gds", "--shot", "99"), "--shot 99: the study has 0 to 5"),
        (("--out", "a.gds"), "is grey; give 'binary', or --halftone with a cell, such as 4um"),
        (("--out", "a.gds", "--halftone", "20um,x"), "density"),
    ],
)
def test_what_cannot_be_written_is_one_line(file, options, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert message in one_line(call("plate", file, *options))
    assert not list(tmp_path.iterdir())
