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
