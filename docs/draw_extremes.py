"""Draws the errors of docs/measured/extremes.md: `python docs/draw_extremes.py`."""

import re
from pathlib import Path

from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[1]
PAGE, PICTURE = ROOT / "docs/measured/extremes.md", ROOT / "docs/images/extremes.png"
NAMED = ("the thesis' camera", "focus", "d = 1 mm, pixel average")

values = PAGE.read_text("utf-8").partition("## Gradients")[0]
found = re.findall(r"^\| ([^|]+) \| (\S+) < \S+ \| (\S+) < ", values, re.MULTILINE)
rows = sorted((float(single), float(double), name) for name, single, double in found)
figure = Figure(figsize=(8, 3.6), layout="constrained")
axes = figure.subplots()
places = range(len(rows))
axes.semilogy(places, [row[0] for row in rows], "o", color="0.15", ms=4, label="float32")
axes.semilogy(places, [row[1] for row in rows], "o", color="0.6", ms=4, label="float64")
for place, (single, _, name) in enumerate(rows):
    if name in NAMED:
        above = {"textcoords": "offset points", "ha": "right", "size": 8}
        axes.annotate(name, (place, single), (3, 8), **above)
axes.set(xlabel="camera, sorted", ylabel="relative L2 error of the PSF", ylim=(1e-16, 1))
axes.legend(loc="upper left", frameon=False)
figure.savefig(PICTURE, dpi=110)
