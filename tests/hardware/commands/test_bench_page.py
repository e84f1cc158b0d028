"""The page of the bench, followed from an empty folder on the virtual rig."""

import json
import re
import shlex

import jax
import pytest
from commands.test_cli import runner

from helpers import ROOT
from thincam_jax.commands import cli
from thincam_jax.hardware.commands import command

PAGE = (ROOT / "docs/guide/bench.md").read_text("utf-8")


def commands():
    """Those in the page's blocks and in its tables, each once, in order."""
    blocks = re.findall(r"```\n(.*?)```", PAGE, re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    lines += re.findall(r"\| `(thincam .*?)` \|", PAGE)
    return dict.fromkeys(" ".join(shlex.split(line, comments=True)) for line in lines)


def test_the_page_has_a_command_for_every_step():
    assert len(commands()) >= 10
    table = PAGE[PAGE.index("## Check list") :]
    rows = [line for line in table.splitlines() if line.startswith("| ")][1:]
    assert rows and all(re.search(r"\| `thincam .*` \|$", row) for row in rows)


@pytest.mark.thorough
def test_it_is_followed_from_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    seen = []
    monkeypatch.setattr(command, "serve_page", lambda preview, *_: seen.append(preview.view()))
    for line in commands():
        result = runner.invoke(cli.app, shlex.split(line)[1:], input="\n" * 9)
        assert result.exit_code == 0, f"{line}: {result.output}"
    assert seen[0].pictures["frame"] and seen[0].pictures["image"]
    metrics = json.loads((tmp_path / "runs/rig_manual/metrics.json").read_text("utf-8"))
    assert [one["status"] for one in metrics["registration"]] == ["reference", "moved"]
    assert max(metrics["agreement"]["frame_residual_over_noise"]) < 1.03
    report = (tmp_path / "runs/rig_manual/report.html").read_text("utf-8")
    assert "Registration of the shots" in report and "stood elsewhere than read" in report
    assert (tmp_path / "plate.gds").is_file() and (tmp_path / "plate.tif").is_file()


def test_the_numbers_of_the_hologram(capsys):
    (block,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    with jax.enable_x64(False):
        exec(block, {})  # the project's own page
    printed = [float(word) for word in capsys.readouterr().out.split()]
    assert printed == pytest.approx([532.0, 529.41], abs=0.01)
