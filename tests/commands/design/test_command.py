"""The command `thincam design`: what it prints, its exit codes, and its one line for each fault."""

import numpy as np
import pytest
import skimage.io
from commands.design import tiny
from commands.test_cli import call, one_line

from thincam_jax.commands.design import run as designs


@pytest.fixture
def file(tmp_path):
    return tiny.write(tmp_path)


@pytest.fixture
def interrupted(monkeypatch):
    """Ctrl-C as the run begins, and what it was given."""
    given = []

    def run(study, folder, progress):
        given.append((study.study.config, folder.path))
        progress("search", 4)
        raise KeyboardInterrupt

    monkeypatch.setattr(designs, "run_design", run)
    return given


def test_interrupt(file, interrupted, tmp_path, monkeypatch):
    """The default folder is named after the design."""
    monkeypatch.chdir(tmp_path)
    result = call("design", file, "--set", "seed=9", "--set", "title=T")
    assert result.exit_code == 130
    assert "thincam: interrupted; the same command goes on" in result.stderr
    ((config, folder),) = interrupted
    assert (config.seed, config.title, folder.as_posix()) == (9, "T", "runs/tiny-design")


class TestExitCode2:
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
    def test_fault_before_anything_runs(self, file, tmp_path, setting, part):
        out = tmp_path / "out"
        assert part in one_line(call("design", file, "--set", setting, "--out", out))
        assert not out.exists()

    def test_a_picture_too_small_to_measure(self, file, tmp_path):
        small = ("--set", "prior={measured: true}", "--set", "targets.1.path=small.png")
        image = np.arange(20 * 40, dtype=np.uint8).reshape(20, 40)
        skimage.io.imsave(tmp_path / "small.png", image, check_contrast=False)
        line = one_line(call("design", file, *small))
        assert line.startswith("targets[1]: 20×40 pixels are too few to measure a spectrum")

    def test_folder_of_another_configuration(self, file, tmp_path):
        out = tmp_path / "out"
        designs.DesignFolder(out).claim(tiny.load(file))
        line = one_line(call("design", file, "--out", out, "--set", "seed=8"))
        assert line.startswith(f"--out {out}: holds a design of another configuration (see {out}")
        line = one_line(call("design", file, "--out", tmp_path))
        assert "is not empty and holds no design" in line

    def test_a_study_is_told_apart(self, file):
        assert "give it to 'thincam design'" in one_line(call("run", file))
