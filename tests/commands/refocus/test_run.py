"""Refocus experiments: what a file may say, what a run finds and leaves behind."""

import json
import re

import pytest
from commands.pages import assert_says_its_result
from commands.refocus import tiny
from commands.study.tiny import Told

from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.refocus import build_refocus, run_refocus
from thincam_jax.commands.run_folder import RunFolder


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    home = tmp_path_factory.mktemp("refocus")
    study, texts = build_refocus(tiny.experiment(home)), Told()
    folder = RunFolder(home / "out")
    result = run_refocus(study, folder, texts)
    metrics = json.loads((folder.path / "metrics.json").read_text("utf-8"))
    assert [row[2] for row in result.table().rows] == [
        found["found_mm"] for found in metrics["objects"].values()
    ]
    return study, folder.path, metrics, texts


def test_report_stands_alone_and_is_escaped(run):
    page = assert_says_its_result(run[1])
    sources = re.findall(r'src="([^"]+)"', page)
    assert len(sources) == 5
    assert all(source.startswith("data:image/") for source in sources)
    assert "<script" not in page
    assert "&lt;b&gt;of its own&lt;/b&gt;" in page
    assert "near, placed at 20 mm, is sharpest at" in page
    parts = re.findall(r'href="#(\w+)"', page)
    assert parts == re.findall(r'<h2 id="(\w+)">', page)  # the contents
    assert len(parts) == 6


@pytest.mark.parametrize(
    ("override", "part"),
    [
        (
            "sweep.method=best",
            "sweep.method: 'best' is no method; choose one of conventional, wiener",
        ),
        ("objects.0.distance=12 mm", "objects[0].distance: 12 mm lies outside of the sweep"),
        ("sweep.nearest=95 mm", "sweep.nearest: nearest is not below farthest"),
        ("objects.1.name=near", "objects[1].name: 'near' and 'near'"),
        ("noise=null", "wiener weighs noise against signal"),
    ],
)
def test_faults_are_told_in_one_line(override, part, tmp_path):
    with pytest.raises(ConfigError) as caught:
        tiny.experiment(tmp_path, override)
    (line,) = str(caught.value).split("\n")
    assert part in line


@pytest.mark.parametrize(
    ("override", "part"),
    [
        ("objects.0.width=0.1 mm", "objects[0]: covers 1 pixels of a reconstruction"),
        ("mask.pixel_pitch=0.7 mm", "mask, sensor or model: "),
    ],
)
def test_what_only_building_shows_is_refused(override, part, tmp_path):
    with pytest.raises(ConfigError) as caught:
        build_refocus(tiny.experiment(tmp_path, override))
    (line,) = str(caught.value).split("\n")
    assert part in line
