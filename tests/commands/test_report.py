"""A report's texts, tables and figures, as a page and in a terminal."""

import base64
import io
import re

import numpy as np
import PIL.Image

from thincam_jax._core.table import Table
from thincam_jax.commands.report import Gallery, Page, Part, Picture, Sentences, render_report
from thincam_jax.commands.sections import ExperimentConfig
from thincam_jax.commands.terminal import show
from thincam_jax.imaging.display import png_bytes

ENVIRONMENT = {
    "precision": "float32",
    "devices": ["cpu"],
    "platform": "none",
    "python": "3.11",
    "seconds": 3.2,
    "command": ["thincam", "run", "a.yaml"],
    "date": "2026-11-25 10:00+01:00",
    "commit": None,
    "versions": {"numpy": "2.4", "dask": None},
}
TABLE = Table(("method", "PSNR\ndB", "others"), [("A <b>", 30.06, "29.0")], (1,), published=(2,))


def rendered(page, tmp_path):
    (tmp_path / "figures").mkdir(exist_ok=True)
    (tmp_path / "figures/psf.png").write_bytes(png_bytes(np.zeros((20, 1700), np.uint8)))
    config = ExperimentConfig(name="a test", title="Title & more", seed=7)
    return render_report(page, config, tmp_path, ENVIRONMENT)


def test_a_page_holds_what_it_is_given_and_leaves_out_what_is_empty(tmp_path):
    parts = (
        Part("Results of it all", (TABLE, "Of `tc.psf` & others."), short="Results"),
        Part("Nothing", ()),
        Part("Nothing drawn", (Picture("absent.png", "Absent"), Sentences(()), "")),
        Part("PSF", (Picture("psf.png", "A PSF", "Its `caption`.", folded="all of it"),)),
    )
    page = rendered(
        Page(("Lead.", Sentences(("one", "two"))), parts, warnings=("too few",)), tmp_path
    )
    assert (
        "<title>Title &amp; more</title>" in page and "<strong>Warning:</strong> too few." in page
    )
    assert re.findall(r'href="#([\w-]+)"', page) == re.findall(r'<h2 id="([\w-]+)">', page)
    assert re.findall(r'<h2 id="([\w-]+)">', page) == [
        "results",
        "nothing-drawn",
        "psf",
        "computed",
    ]
    assert "<th>PSNR<br>dB</th>" in page and "<td>A &lt;b&gt;</td>" in page
    assert '<td class="published">29.0</td>' in page
    assert "<p>Of <code>tc.psf</code> &amp; others.</p>" in page
    assert "<ul><li>one</li><li>two</li></ul>" in page and page.count("<ul>") == 1
    # What is folded is not in the page, but beside it.
    folded = '<a href="figures/psf.png"><img src="figures/psf.png" loading="lazy" alt="A PSF"></a>'
    assert f"<summary>all of it</summary><figure>{folded}" in page and page.count("<img") == 1
    assert "<code>thincam run a.yaml</code>, 2026-11-25 10:00+01:00.\n" in page
    assert "<figcaption>Its <code>caption</code>.</figcaption>" in page
    assert "seed: 7" in page and "not installed" in page


def test_pictures_are_small_copies_that_lead_to_their_files(tmp_path):
    one = Picture("psf.png", "A PSF", "first\nsecond")
    page = rendered(
        Page((one, Gallery((one, Picture("absent.png", "Absent")))), result="A > B."), tmp_path
    )
    assert page.index('<p class="result">A &gt; B.</p>') < page.index("<img")
    copies = re.findall(
        r'<a href="figures/psf.png"><img src="data:image/webp;base64,([^"]+)"', page
    )
    sizes = [PIL.Image.open(io.BytesIO(base64.b64decode(copy))).size for copy in copies]
    assert sizes == [(850, 10), (400, 5)]
    assert page.count("<figcaption>first<br>second</figcaption>") == 2


def test_a_page_of_one_part_needs_no_contents(tmp_path):
    assert "<nav>" not in rendered(Page(("Lead.",), (Part("Only", ("Text.",)),)), tmp_path)


def test_a_table_is_the_same_in_a_terminal(capsys):
    show(TABLE)
    shown = capsys.readouterr().out
    assert all(text in shown for text in ("method", "PSNR", "dB", "A <b>", "30.1", "29.0"))
