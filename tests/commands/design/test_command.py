"""The command `thincam design`: what it prints, its exit codes, and its one line for each fault."""

import numpy as np
import pytest
import skimage.io
from commands.design import tiny
from commands.test_cli import call, one_line

from thincam_jax.commands.design import run as designs

FOUND = {
    "reference": {"name": "pairs", "shots": [{"beta_rad_per_mm2": 25.0, "distance_mm": 3.0}]},
    "compare": [],
    "objective": {"name": "bayes_error"},
    "found": [
        {
            "name": f"found {rank}",
            "shots": [{"beta_rad_per_mm2": 17.126, "distance_mm": 2.5}],
            "predicted_gain": 0.187,
        }
        for rank in (1, 2)
    ],
    "validation": {
        "pictures": ["picture"],
        "charts": ["chart"],
        "methods": {
            "pairs": {
                "picture": {"psnr_db": {"mean": 24.127, "deviation": 0.1}},
                "chart": {"psnr_db": None},
            },
            "found 1": {
                "picture": {"psnr_db": {}, "gain_db": {"mean": 0.456, "deviation": 0.1}},
                "chart": {"psnr_db": {}, "gain_elements": None},
            },
        },
    },
}


@pytest.fixture
def file(tmp_path):
    return tiny.write(tmp_path)


@pytest.fixture
def asked(monkeypatch):
    """In place of a design's run: what it was asked for."""
    given = []

    def run(study, folder, progress):
        given.append((study.config, folder.path))
        progress("search", 4)
        return FOUND

    monkeypatch.setattr(designs, "run_design", run)
    return given


def test_options_and_what_is_printed(file, asked, tmp_path):
    out = tmp_path / "out"
    result = call("design", file, "--out", out, "--set", "seed=9", "--set", "title=T")
    assert result.exit_code == 0, result.output
    ((config, folder),) = asked
    assert (config.seed, config.title, folder) == (9, "T", out)
    rows = [line for line in result.stdout.splitlines() if "│" in line]
    table = [[cell.strip() for cell in row.split("│")[1:-1]] for row in rows]
    assert table == [  # those that are simulated
        ["pairs", "–", "–", "–"],
        ["β 25.00 at 3.00 mm", "", "", ""],
        ["found 1", "+0.19", "+0.46", "–"],
        ["β 17.13 at 2.50 mm", "", "", ""],
    ]
    heading = [line.split("┃")[1:-1] for line in result.stdout.splitlines() if "┃" in line]
    units = ["design", "gain, dB", "gain, dB", "gain, elements"]
    assert [cell.strip() for cell in heading[1]] == units
    assert "gains are over pairs, whose PSNR is: picture 24.13 dB\n" in result.stdout
    assert f"report: {out / 'report.html'}" in result.stdout
    assert result.stderr == ""


def test_default_folder_is_named_after_the_design(file, asked, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call("design", file).exit_code == 0
    assert asked[0][1].as_posix() == "runs/tiny-design"


def test_interrupt(file, monkeypatch, tmp_path):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(designs, "run_design", interrupted)
    result = call("design", file, "--out", tmp_path / "out")
    assert result.exit_code == 130
    assert result.stderr.startswith("thincam: interrupted; the same command goes on")


class TestExitCode2:
    def test_missing_file(self, tmp_path):
        line = one_line(call("design", tmp_path / "no.yaml"))
        assert line == f"{tmp_path / 'no.yaml'} is missing; give the path of a YAML experiment file"

    @pytest.mark.parametrize(
        ("setting", "part"),
        [
            ("search.free.0.bounds=[9 /mm^2, 8 /mm^2]", "bounds cross: 9 to 8 rad/mm^2"),
            ("search.limits.mask_pixel=0.2 mm", "no design is feasible: beta of capture 1, 2 ≥ 12"),
            ("search.limits.captures=0", "a whole number from 1 to 8"),
            ("targets.1.path=missing.png", "targets[1]: "),
            ("pareto.light.bounds=[10, 100]", "pareto.light: light needs noise that counts elec"),
            ("pareto.thickness.bounds=[2 mm, 3 mm]", "pareto.thickness: no distance is free"),
            ("sensor.shape=[4, 64]", "sensor.shape: 4×64 pixels are too few"),
        ],
    )
    def test_fault_before_anything_runs(self, file, asked, tmp_path, setting, part):
        out = tmp_path / "out"
        assert part in one_line(call("design", file, "--set", setting, "--out", out))
        assert not asked
        assert not out.exists()

    def test_a_picture_too_small_to_measure(self, file, asked, tmp_path):
        small = ("--set", "prior={measured: true}", "--set", "targets.1.path=small.png")
        image = np.arange(20 * 40, dtype=np.uint8).reshape(20, 40)
        skimage.io.imsave(tmp_path / "small.png", image, check_contrast=False)
        line = one_line(call("design", file, *small))
        assert line.startswith("targets[1]: 20×40 pixels are too few to measure a spectrum")

    def test_folder_of_another_configuration(self, file, tmp_path, monkeypatch):
        def claim(study, folder, _):
            folder.claim(study.config)
            return FOUND

        monkeypatch.setattr(designs, "run_design", claim)
        out = tmp_path / "out"
        assert call("design", file, "--out", out).exit_code == 0
        line = one_line(call("design", file, "--out", out, "--set", "seed=8"))
        assert line.startswith(f"--out {out}: holds a design of another configuration (see {out}")
        line = one_line(call("design", file, "--out", tmp_path))
        assert "is not empty and holds no design" in line

    def test_a_study_is_told_apart(self, file):
        assert "give it to 'thincam design'" in one_line(call("run", file))


@pytest.mark.thorough
def test_coarse_pixels_are_told_once(file, asked, tmp_path):
    result = call("design", file, "--out", tmp_path / "out", "--set", "sensor.pitch=88um")
    assert result.exit_code == 0, result.output
    (line,) = result.stderr.splitlines()
    assert line.startswith("thincam: warning: the mask casts 7.73 cycles/mm on pixels that resolve")
