"""`thincam init`: every shipped experiment file can be had, and nothing is overwritten."""

import re
import tomllib
from pathlib import Path
from urllib.parse import unquote, urljoin, urlsplit

import pytest
from commands.test_cli import call, called, one_line

from helpers import ROOT
from thincam_jax.commands import kinds
from thincam_jax.commands.kinds import load_experiment

FILES = sorted((ROOT / "configs").glob("*.yaml"))


def test_every_shipped_file_is_one_that_its_command_takes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for kind in kinds.examples():
        result = called("init", kind)
        command = kinds.read_kind(tmp_path / f"{kind}.yaml").command
        assert result.stdout == f"{kind}.yaml; next: thincam {command} {kind}.yaml\n"
        load_experiment(tmp_path / f"{kind}.yaml", command=command)
    assert len(kinds.examples()) == len(FILES)
    (tmp_path / "folder").mkdir()
    assert call("init", "study", "--out", tmp_path / "folder").exit_code == 0
    assert (tmp_path / "folder/study.yaml").exists()
    assert {without_name(path) for path in tmp_path.glob("*.yaml")} == {
        without_name(p) for p in FILES
    }


def without_name(path):
    """A file whose name is that of its experiment, which names its run folder, too.

    Its first line leads an editor to the schema that lies with the shipped files, from anywhere.
    """
    header, text = path.read_text("utf-8").split("\n", 1)
    place = header.removeprefix("# yaml-language-server: $schema=")
    schema = urlsplit(urljoin(path.as_uri(), place)).path
    assert Path(unquote(schema)) == ROOT / f"configs/schemas/{kind_name(path)}.json"
    assert f"\nname: {path.stem}\n" in text
    return text.replace(f"\nname: {path.stem}\n", "")


def kind_name(path):
    """The name of a file's kind."""
    found = kinds.read_kind(path)
    return next(name for name, kind in kinds.KINDS.items() if kind is found)


def test_the_page_of_commands_lists_them():
    page = (ROOT / "docs/files/commands.md").read_text("utf-8")
    table = page.split("| example | experiment |")[1].split("\n\n")[0]
    cells = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    assert sorted(re.findall(r"`(\w+)`", " ".join(cells))) == sorted(kinds.examples())


def test_nothing_is_overwritten(tmp_path):
    path = tmp_path / "mine.yaml"
    assert call("init", "study", "--out", path).exit_code == 0
    path.write_text("mine", "utf-8")
    assert one_line(call("init", "study", "--out", path)).startswith(f"{path} exists; give another")
    assert path.read_text("utf-8") == "mine"


def test_unknown_kind_and_missing_folder(tmp_path):
    line = one_line(call("init", "camera"))
    named = "study, refocus, screen, design, cells, capture, denoiser, "
    assert line.startswith(f"init camera: choose one of {named}")
    path = tmp_path / "no" / "study.yaml"
    line = one_line(call("init", "study", "--out", path))
    assert "cannot be written (No such file or directory); make its folder first, or give" in line
    path.parent.mkdir()  # as it was advised
    assert call("init", "study", "--out", path).exit_code == 0


def test_the_wheel_holds_them_where_they_are_looked_for(tmp_path, monkeypatch):
    """There they come before those of a repository around it."""
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["hatch"]["build"]
    place = wheel["targets"]["wheel"]["force-include"]["configs"]
    (tmp_path / place).mkdir(parents=True)
    (tmp_path / place / "camera.yaml").write_text("", "utf-8")
    module = Path(kinds.__file__).relative_to(ROOT)
    monkeypatch.setattr(kinds, "__file__", str(tmp_path / module))
    named = ["study", "refocus", "screen", "design", "cells", "capture", "camera"]
    assert kinds.examples() == named


def test_a_design_for_an_own_sensor(tmp_path):
    path = tmp_path / "own.yaml"
    given = ("init", "design", "--sensor", "1200x1600", "--pitch", "2 um", "--out", path)
    assert call(*given).exit_code == 0
    config = load_experiment(path, command="design")
    assert config.sensor.shape == (1200, 1600)
    assert config.sensor.pitch == pytest.approx(0.002)
    assert config.mask.width == pytest.approx(2.4)
    low, high = config.search.free[0].bounds
    assert low == pytest.approx(16 * 3.14159 / 2.4**2, rel=1e-3)
    assert high == pytest.approx(3.14159 / (0.002 * 2.4), rel=1e-3)
    assert config.search.frequencies.exact == 256


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (("design", "--sensor", "1500", "--pitch", "3um"), "give rows and columns, as --sensor 15"),
        (("design", "--pitch", "3um"), "give rows and columns, as --sensor 1500x2000"),
        (("design", "--sensor", "1500x2000"), "write a length such as"),
        (("design", "--sensor", "0x20", "--pitch", "3um"), "shape"),
        (("study", "--pitch", "3um"), "are for a design: thincam init design"),
    ],
)
def test_a_sensor_that_is_none(given, told, tmp_path):
    path = tmp_path / "own.yaml"
    assert told in one_line(call("init", *given, "--out", path))
    assert not path.exists()
    # As it was advised.
    assert (
        call("init", "design", "--sensor", "15x20", "--pitch", "3um", "--out", path).exit_code == 0
    )
