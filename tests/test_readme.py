"""The examples of the README and the documentation run as they stand."""

import re
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]


def run_examples(page: str) -> dict:
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text("utf-8"), re.DOTALL)
    assert blocks
    names: dict = {}
    for block in blocks:
        exec(block, names)  # the project's own pages
    return names


def test_readme(capsys):
    names = run_examples("README.md")
    assert names["h"].shape == names["H"].shape == (1024, 1024)
    # The mean of ¼(1 + cos)² is 3/8 of the open aperture's light.
    assert abs(float(np.mean(names["h"][256:768, 256:768])) - 3 / 8) < 0.01
    assert np.isfinite(float(capsys.readouterr().out.split()[0]))


def test_documentation(capsys):
    names = run_examples("docs/index.md")
    assert names["result"].image.shape == (3, 130, 196)
    status, decibels = capsys.readouterr().out.split()
    assert status == "ok"
    assert float(decibels) > 20


def test_accuracy_page(capsys):
    """The printed choice stands in the page, and the plan is within its tolerance."""
    names = run_examples("docs/accuracy.md")
    printed = capsys.readouterr().out
    page = (ROOT / "docs/accuracy.md").read_text("utf-8")
    assert not re.findall(r"\b[A-Z]{7,}\b", page)  # no figure left to be filled in
    choice = names["choice"]
    assert f"{choice.model} {choice.precision} {choice.predicted_error:.4f}" in page
    *told, rounding, fresnel = choice.reasons
    assert all(sentence in page and sentence in printed for sentence in (*told, fresnel))
    assert rounding in printed  # its last digit depends on the precision of the camera's numbers
    full = names["tc"].capture(names["small"], names["scene"])
    assert str(names["plan"]) in printed
    assert (
        str(names["plan"]).splitlines()[2:5]
        == re.findall(r"\n(depth planes.*\n.*\n.*)", page)[0].splitlines()
    )
    assert np.linalg.norm(names["image"] - full) < 1e-2 * np.linalg.norm(full)
