"""The README's example runs as it stands."""

import re
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]


def test_example(capsys):
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), re.DOTALL)
    names = {}
    for block in blocks:
        exec(block, names)  # the README is the project's own
    assert names["h"].shape == (1024, 1024)
    # The mean of ¼(1 + cos)² is 3/8 of the open aperture's light.
    assert abs(float(np.mean(names["h"][256:768, 256:768])) - 3 / 8) < 0.01
    assert names["H"].shape == (1024, 1024)
    assert np.isfinite(float(capsys.readouterr().out.split()[0]))
