"""The scripts of experiments/ at their reduced size: their own assertions, and their figures."""

import ast
import os
import re
import runpy

import jax
import matplotlib.pyplot as plt
import PIL.Image
import pytest
import skimage.io

from helpers import ROOT

SCRIPTS = sorted((ROOT / "experiments").glob("*.py"))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_a_script_begins_with_a_title(script):
    """Of reStructuredText, and a question or subject that fits below a thumbnail."""
    title, line, blank, *_ = ast.get_docstring(ast.parse(script.read_text("utf-8"))).splitlines()
    assert line == "=" * len(title) and not blank and len(title) < 60


def test_every_script_has_a_card_in_the_gallery():
    """A square within a figure of docs/images."""
    tree = ast.parse((ROOT / "docs/conf.py").read_text("utf-8"))
    tables = (one for one in tree.body if isinstance(one, ast.Assign))
    cards = next(one.value for one in tables if ast.unparse(one.targets[0]) == "CARDS")
    cards = ast.literal_eval(cards)
    assert cards.keys() == {script.stem for script in SCRIPTS}
    for name, left, top, side in cards.values():
        with PIL.Image.open(ROOT / "docs/images" / name) as figure:
            width, height = figure.size
        assert min(left, top) >= 0 and left + side <= width and top + side <= height, name


def test_a_study_and_a_design_in_25_lines():
    """Text, comments and blank lines do not count; no file is read or written."""
    text = (ROOT / "experiments/in_a_notebook.py").read_text("utf-8")
    code = ast.parse(text).body[1:]
    lines = {line for one in code for line in range(one.lineno, one.end_lineno + 1)}
    assert len(lines) <= 25 and not re.search(r"open\(|Path|savefig|yaml[^`]", text)


# XLA converts float16 by F16C only, which processors have since 2012.
WITHOUT_HALF = pytest.mark.skipif(
    "SSE4_2" in os.environ["XLA_FLAGS"], reason="XLA has no float16 in these instructions"
)


def marked(script):
    """Most take ten seconds and more, even small."""
    marks = [] if script.stem == "limit_of_masks" else [pytest.mark.thorough]
    if "float16" in script.read_text("utf-8"):
        marks.append(WITHOUT_HALF)
    return pytest.param(script, id=script.stem, marks=marks)


@pytest.mark.parametrize("script", [marked(script) for script in SCRIPTS])
def test_a_script_runs_and_draws(script, monkeypatch, tmp_path):
    """In a user's precision. Every panel with a scale says what it shows, and in which unit."""
    monkeypatch.setenv("THINCAM_SIZE", "small")
    monkeypatch.setenv("THINCAM_FIGURES", str(tmp_path))
    with jax.enable_x64(False), jax.numpy_dtype_promotion("standard"):
        runpy.run_path(str(script))
    try:
        panels = [ax for number in plt.get_fignums() for ax in plt.figure(number).axes]
        labelled = [ax for ax in panels if ax.get_xlabel() or ax.get_ylabel()]
        assert len(labelled) >= 4
        drawn = [tmp_path / f"{number}.png" for number in plt.get_fignums()]
        for number, picture in zip(plt.get_fignums(), drawn, strict=True):
            plt.figure(number).savefig(picture)
    finally:
        plt.close("all")
    pictures = list((tmp_path / script.stem).glob("*.png")) or drawn
    assert len(pictures) >= 2
    for picture in pictures:
        assert skimage.io.imread(picture).std() > 1  # something is drawn
