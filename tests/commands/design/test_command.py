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
    def test_a_picture_too_small_to_measure(self, file, tmp_path):
        small = ("--set", "prior={measured: true}", "--set", "targets.1.path=small.png")
        image = np.arange(20 * 40, dtype=np.uint8).reshape(20, 40)
        skimage.io.imsave(tmp_path / "small.png", image, check_contrast=False)
        line = one_line(call("design", file, *small))
        assert line.startswith("targets[1]: 20×40 pixels are too few to measure a spectrum")
