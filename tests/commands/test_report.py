"""A report's texts, tables and figures, as a page and in a terminal."""

import base64
import io
import re
import shutil

import numpy as np
import PIL.Image
import pytest

from thincam_jax._core.table import Table
from thincam_jax.commands.report import Gallery, Page, Part, Picture, render_report
from thincam_jax.commands.sections import ExperimentConfig
from thincam_jax.imaging.encoding import png_bytes

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


def test_pictures_are_small_copies_that_lead_to_their_files(tmp_path):
    one = Picture("psf.png", "A PSF", "first\nsecond")
    page = rendered(
        Page((one, Gallery((one, Picture("absent.png", "Absent")))), result="A > B."), tmp_path
    )
    assert page.index('<p class="result">A &gt; B.</p>') < page.index("<img")
    copies = re.findall(
        # No part moves once pictures are there: those in the page do not wait.
        r'<a href="figures/psf.png"><img src="data:image/webp;base64,([^"]+)" alt',
        page,
    )
    sizes = [PIL.Image.open(io.BytesIO(base64.b64decode(copy))).size for copy in copies]
    assert sizes == [(850, 10), (400, 5)]
    assert page.count("<figcaption>first<br>second</figcaption>") == 2


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_page_is_read_in_light_and_dark_and_on_a_phone(tmp_path, scheme):
    """Text stands out from its ground by what WCAG asks for, 7; and nothing is wider than 390."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    chromium = shutil.which("chromium") or pytest.skip("chromium is not installed")
    picture = Picture("psf.png", "A PSF", "Its caption.")
    page = rendered(Page((picture, TABLE), (Part("PSF", ("T.",)),), result="A > B."), tmp_path)
    (tmp_path / "report.html").write_text(page, "utf-8")
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        view = browser.new_page(color_scheme=scheme, viewport={"width": 390, "height": 900})
        view.goto((tmp_path / "report.html").as_uri())
        assert view.evaluate("document.documentElement.scrollWidth") <= 390
        # Letters of 12 pixels in 850 are of 10 in this; the figure is moved sideways instead.
        assert view.evaluate("document.images[0].clientWidth") == 704
        light = [
            view.locator(one).first.evaluate(
                """(one, name) => {
                    const context = new OffscreenCanvas(1, 1).getContext("2d");
                    context.fillStyle = getComputedStyle(one)[name];
                    context.fillRect(0, 0, 1, 1);
                    const linear = (v) => v <= 10 ? v / 3294 : ((v / 255 + 0.055) / 1.055) ** 2.4;
                    const [r, g, b] = [...context.getImageData(0, 0, 1, 1).data].map(linear);
                    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
                }""",
                name,
            )
            for one, name in (
                ("body", "backgroundColor"),
                (".result", "color"),
                ("figcaption", "color"),
                (".published", "color"),
            )
        ]
        browser.close()
    ground, *texts = light
    assert ground < 0.05 if scheme == "dark" else ground > 0.9
    for text in texts:
        low, high = sorted((ground, text))
        assert (high + 0.05) / (low + 0.05) > 7
