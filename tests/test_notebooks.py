"""Notebooks as users run them: no warning, and every figure once."""

import re

import numpy as np
import PIL.Image
import pytest
import skimage.data

from helpers import ROOT

nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")
nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")
pytest.importorskip("ipykernel", reason="ipykernel is not installed")
pytestmark = pytest.mark.thorough


def cells_of(script: str) -> list[str]:
    """Code of a script of experiments/, divided at `# %%` as in the notebook to download."""
    text = (ROOT / "experiments" / f"{script}.py").read_text("utf-8")
    return re.split(r"^# %%.*\n(?:#.*\n)*", text, flags=re.MULTILINE)


def outputs_of(cells: list[str], folder, monkeypatch) -> list[dict[str, str]]:
    """What a notebook shows, by type; nothing is on stderr."""
    for name in ("MPLBACKEND", "JAX_PLATFORMS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("THINCAM_SIZE", "small")
    monkeypatch.setenv("THINCAM_FIGURES", str(folder))
    monkeypatch.setenv("IPYTHONDIR", str(folder / "ipython"))
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in cells])
    where = {"metadata": {"path": str(folder)}}
    nbclient.NotebookClient(book, timeout=600, kernel_name="python3", resources=where).execute()
    outputs = [output for cell in book.cells for output in cell.outputs]
    assert not [o.text for o in outputs if o.get("name") == "stderr"]
    return [dict(o.get("data", {})) for o in outputs]


def pictures_of(cells: list[str], folder, monkeypatch) -> list[str]:
    """PNG pictures that a notebook shows."""
    shown = outputs_of(cells, folder, monkeypatch)
    return [o["image/png"] for o in shown if "image/png" in o]


def test_first_image_with_an_own_mask_and_photograph(tmp_path, monkeypatch):
    """The block of the Start page, of at most twelve lines; its lines of progress are gone."""
    page = (ROOT / "docs/start.md").read_text("utf-8").split("## First image")[1]
    block = page.split("```python\n")[1].split("```")[0]
    assert len([line for line in block.splitlines() if line]) <= 12
    PIL.Image.fromarray(skimage.data.chelsea()).save(tmp_path / "photo.jpg")
    cells = np.random.default_rng(0).integers(0, 2, (40, 40), dtype=np.uint8)
    mask = PIL.Image.fromarray(np.kron(255 * cells, np.ones((10, 10), np.uint8)))
    mask.save(tmp_path / "mask.png")
    assert mask.size == (400, 400)
    shown = outputs_of([f"{block}figure"], tmp_path, monkeypatch)
    assert sum("image/png" in one for one in shown) == 1
    assert {"text/plain": ""} in shown


@pytest.mark.parametrize("script", ["in_a_notebook", "real_capture"])
def test_a_script_as_a_notebook(script, tmp_path, monkeypatch):
    """A design by gradient with its landscape; a capture from files, the real one where it is."""
    hand = ROOT.parent / "shared/data/diffusercam-hand"
    if hand.exists():
        monkeypatch.setenv("THINCAM_HAND", str(hand))
    cells = cells_of(script)
    shown = pictures_of(cells, tmp_path, monkeypatch)
    assert len(shown) == len(set(shown)) == {"in_a_notebook": 5, "real_capture": 2}[script]


WIDGET = """
import thincam_jax as tc
from thincam_jax.units import um
mask = tc.FresnelZoneAperture(25.0, width=1.6)
explorer = tc.explore(tc.LenslessCamera(mask, tc.Sensor((48, 64), 30 * um), distance=5.0))
explorer
"""
TURNED = """
import json
sent = []
explorer.send = lambda content, buffers: sent.append((content, buffers))
# What the page's module sends over the notebook's comm.
asked = {"id": 1, "values": {"beta": 18.0}, "rest": False}
message = {"content": {"data": {"method": "custom", "content": asked}}, "buffers": []}
explorer._handle_msg(message)
camera = explorer.camera
tc.plot.psf(camera, **explorer.light)
"""
CHECKED = """
assert "application/vnd.jupyter.widget-view+json" in str(explorer._repr_mimebundle_())
((content, pictures),) = sent
assert json.loads(content["header"])["values"]["beta"] == float(camera.mask.beta) == 18.0
assert pictures[0][:2] == b"\\xff\\xd8" and camera.distance == 5.0
"""


def test_the_explorer_in_a_notebook(tmp_path, monkeypatch):
    """A widget's view, a move, and the camera as it is set in the next cell."""
    pytest.importorskip("anywidget", reason="anywidget is not installed")
    assert len(pictures_of([WIDGET, TURNED, CHECKED], tmp_path, monkeypatch)) == 1
