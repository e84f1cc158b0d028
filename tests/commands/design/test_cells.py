"""Files of kind cells from file to folder, going on after Ctrl-C, and one line for each fault."""

import json

import numpy as np
import pytest
from commands.pages import assert_says_its_result
from commands.test_cli import call, called, one_line

import thincam_jax as tc
from helpers import quick
from thincam_jax._core.files import read_arrays
from thincam_jax.commands.design.cells import build_cells, run_cells
from thincam_jax.commands.design.run import DesignFolder
from thincam_jax.commands.kinds import load_experiment
from thincam_jax.design import cell_search
from thincam_jax.design.cell_masks import without_lone_cells
from thincam_jax.design.cell_search import CellSettings, find_cells
from thincam_jax.design.objectives import Tolerances
from thincam_jax.design.relief_files import read_height_map

TEXT = """\
name: small cells
kind: cells
seed: 3
wavelength: 500 nm
sensor: {shape: [32, 40], pitch: 40 um}
mask: {cell: 40 um, count: 24, distance: 3 mm}
object: {distance: 100 mm, width: 40 mm}
noise: {read_noise: 20, electrons: 3e5}
prior: {exponent: 2.5}
search: {draws: 12, starts: 2, steps: 10, flips: 8, lone_cells: false}
compare: [one opening, MURA]
"""


def write(folder):
    path = folder / "small.yaml"
    path.write_text(TEXT, "utf-8")
    return path


def built(folder, *overrides):
    return build_cells(load_experiment(write(folder), overrides, "design"))


def camera():
    """That of the file."""
    light, prior = tc.design.PhotonNoise(3e5, 20.0), tc.design.PowerLaw(2.5)
    setup = tc.design.Setup(0.04, 1.28, 100.0, 40.0, noise=light, prior=prior)
    return setup, tc.design.CellMasks(0.04, 24, distance=3.0, wavelength=5e-4)


def ignore(*_):
    """Progress that nobody watches."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """One run of the command: its folder, its record and what it printed."""
    home = tmp_path_factory.mktemp("cells")
    result = called("design", write(home), "--out", home / "out")
    return home / "out", json.loads((home / "out/design.json").read_text("utf-8")), result.stdout


def test_folder_holds_what_the_search_found(whole):
    """The same as in Python, in the file that studies read, and in that of the shop."""
    path, record, _ = whole
    settings = CellSettings(12, 2, 10, flips=8, lone_cells=False, seed=3)
    found = find_cells(*camera(), settings)
    cells = found.masks[0].amplitude
    np.testing.assert_array_equal(tc.read_mask(path / "mask.png", 0.04).amplitude, cells)
    np.testing.assert_array_equal(without_lone_cells(cells), cells)
    assert record["found_db"] == pytest.approx(10 * np.log10(found.error), abs=1e-6)
    assert record["random_db"] == pytest.approx(10 * np.log10(found.random), abs=1e-6)
    assert record["evaluations"] == found.evaluations <= settings.most
    gdstk = pytest.importorskip("gdstk")
    (layout,) = gdstk.read_gds(path / "mask.gds").top_level()
    assert layout.area() == pytest.approx(cells.sum() * 40**2)


def test_page_and_table(whole):
    path, record, printed = whole
    page = assert_says_its_result(path)
    assert "MURA" in page and "limit of shadows" in page and "masks.png" in page
    best = tc.design.recommend(*camera(), kinds=("MURA",), seed=3)[0]
    (mura,) = (one for one in record["kinds"] if one["kind"] == "MURA")
    assert mura["error_db"] == pytest.approx(best.decibels, abs=1e-6)
    beside = record["found_db"] - record["limit_db"]
    side = "below" if beside < 0 else "above"
    assert f"{record['found_db']:.2f} dB, {abs(beside):.2f} dB {side} the limit of" in printed
    assert called("explain", path / "config.yaml").stdout.endswith(" evaluations\n")


def test_interrupted_it_goes_on(whole, tmp_path, monkeypatch):
    """Kinds are not compared again, and the search ends as without the interruption."""
    study, folder = built(tmp_path), DesignFolder(tmp_path / "out")
    stepped, count = cell_search._Problem.stepped, [0]

    def interrupted(*given):
        count[0] += 1
        if count[0] == 22:  # of 6 to choose the start, and 30
            raise KeyboardInterrupt
        return stepped(*given)

    monkeypatch.setattr(cell_search._Problem, "stepped", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_cells(study, folder, ignore)
    assert len(read_arrays(folder.path / "targets/search.npz")["history"]) == 10
    monkeypatch.setattr(type(study), "best_of", None)
    again = run_cells(study, folder, ignore)
    assert count[0] == 22 + 20
    assert again.found_db == whole[1]["found_db"]
    line = one_line(call("design", write(tmp_path), "--out", folder.path, "--set", "seed=4"))
    assert line.startswith(f"--out {folder.path}: holds a design of another configuration")
    (folder.path / "design.json").unlink()  # as if it had not ended
    (folder.path / "targets/search.npz").write_bytes(b"no arrays")
    line = one_line(call("design", write(tmp_path), "--out", folder.path))
    assert line.endswith("search.npz: holds no search; give another folder")


@pytest.mark.parametrize("levels", quick(["phase", "grey"], 0))
def test_files_of_other_levels(tmp_path, levels):
    """Each capture's mask is read back as it is in the file; errors are means over all asked."""
    of_levels = f"mask.levels={levels}", "mask.captures=2", "search.lone_cells=true"
    over = "search.depths=[80 mm, 100 mm, 130 mm]", "search.tolerances={distance: 0.1 mm}"
    study = built(tmp_path, *of_levels, *over, "noise={snr_db: 30}", "compare=[MURA]")
    scores = run_cells(study, DesignFolder(tmp_path / "out"), ignore)
    assert scores.limit_db is None and "limit" not in str(scores.table())
    assert study.settings.depths == (80.0, 100.0, 130.0)
    assert study.tolerances == Tolerances(distance=0.1)
    found = study.find(tmp_path / "out/targets")
    assert scores.found_db == pytest.approx(10 * np.log10(found.error), abs=1e-6)
    for number, mask in enumerate(found.masks, 1):
        name = tmp_path / "out" / f"mask-{number}"
        if levels == "grey":
            read = tc.read_mask(name.with_suffix(".png"), 0.04)
            np.testing.assert_allclose(read.amplitude, mask.amplitude, atol=3e-3)
        else:
            height = read_height_map(name.with_name(f"{name.name}-height.png"))
            phase = 2 * np.pi * 0.52 * np.asarray(height.height) / 5e-4
            np.testing.assert_allclose(np.exp(1j * phase), mask.amplitude, atol=0.02)


FAULTS = """
mask.cels=24 | mask.cels | unknown key; allowed here: cell, count
mask.pitch=40 um | mask.pitch | unknown key
compare=[murra] | compare[0] | did you mean 'MURA'?
mask.cell=40 | mask.cell | 40
mask.cell=40 ms | mask.cell | length
search.depths=[100] | search.depths[0] | 100
mask.levels=gray | mask.levels | did you mean 'grey'?
mask.levels=grey | search.lone_cells | false is for levels binary or binary_phase without rings
search={lone_cells: true, depths: [-1 mm]} | search.depths[0] | -1 mm
mask={cell: 40 um, count: 24, distance: 3 mm, levels: phase, contrast: 9} | mask | leave the contr
search.tolerances={distance: 4 mm} | search.tolerances | distance
search.tolerances={beta: 0.1} | search.tolerances.beta | unknown key
noise={read_noise: 4} | noise | belong together; give both, or snr_db
object.width=90 m | object | give all in mm
"""


@pytest.mark.parametrize("line", FAULTS.strip().splitlines())
def test_faults(tmp_path, line):
    option, field, message = (part.strip() for part in line.split("|"))
    more = ["search.lone_cells=true"] if "contrast" in option else []
    words = [word for one in (option, *more) for word in ("--set", one)]
    told = one_line(call("design", write(tmp_path), "--dry-run", *words))
    assert f"{field}: " in told and message in told.partition(f"{field}: ")[2]


def test_a_misspelt_key_and_command(tmp_path):
    path = write(tmp_path)
    path.write_text(TEXT.replace("draws: 12", "drawz: 12"), "utf-8")
    assert "search.drawz: unknown key" in (line := one_line(call("design", path)))
    assert "did you mean 'draws'?" in line and f"{path}:10: " in line
    assert "give it to 'thincam design'" in one_line(call("run", write(tmp_path)))
