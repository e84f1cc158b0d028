"""The report stands alone, shows everything, and runs nothing that a configuration brings in."""

import base64
import html
import io
import re

import pytest
import skimage.io
from commands.study import tiny
from commands.sweep import mini
from commands.test_cli import call

from thincam_jax.commands.doctor import environment
from thincam_jax.commands.run_folder import RunFolder
from thincam_jax.commands.study.build import build_study
from thincam_jax.commands.study.page import findings, render
from thincam_jax.commands.study.run import run_study

EVIL = "<script>alert(1)</script> & \"quoted\" <img src='http://example.org/x.png'>"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    home = tmp_path_factory.mktemp("report")
    quoted = EVIL.replace("'", "''")
    config = tiny.study(home, f"title='{quoted}'", f"notes=['{quoted}', A second note.]")
    folder = RunFolder(home / "out")
    metrics = run_study(build_study(config), folder, tiny.ignore)
    return config, folder, metrics, (folder.path / "report.html").read_text("utf-8")


def test_no_reference_outside_the_page(run):
    page = run[3]
    tags = " ".join(re.findall(r"<[^>]+>", page))
    sources = re.findall(r"""(?:src|href|srcset|data|action)\s*=\s*["']?([^"'\s>]+)""", tags)
    within = [source for source in sources if source.startswith("#")]
    assert all(f'id="{source[1:]}"' in page for source in within)  # the contents
    pictures = [source for source in sources if source not in within]
    assert len(pictures) == 7  # two targets and their captures, transfer functions, contrast, PSF
    assert all(source.startswith("data:image/png;base64,") for source in pictures)
    tags = set(re.findall(r"<\s*([a-z]\w*)", page))
    assert not tags & {"script", "link", "iframe", "object", "embed", "base"}
    assert not re.search(r"url\(|@import|file://", page)


def test_pictures_are_the_figures(run):
    _, folder, _, page = run
    shown = [base64.b64decode(d) for d in re.findall(r"data:image/png;base64,([^\"]+)", page)]
    assert set(shown) == {p.read_bytes() for p in (folder.path / "figures").glob("*.png")}
    for data in shown:
        picture = skimage.io.imread(io.BytesIO(data))
        assert min(picture.shape[:2]) > 200
        assert picture[..., :3].std() > 5  # something is drawn


def test_motion_is_told(run):
    config, folder, metrics, page = run
    assert "that moves" not in page
    still = config.object
    moving = config.model_copy(update={"object": still.model_copy(update={"motion": 0.25})})
    page = render(moving, folder, metrics, environment())
    assert "that moves 0.25 mm across during an exposure of 1, λ" in page


def test_text_of_the_configuration_is_escaped(run):
    page = run[3]
    assert "<script" not in page
    assert "<img src='http" not in page
    # Title, heading, note and the configuration at the end.
    assert page.count("&lt;script&gt;alert(1)&lt;/script&gt; &amp; ") >= 4
    assert "<p>A second note.</p>" in page


def rows(page):
    """Cells of all table rows, as text."""
    cells = re.findall(r"<tr>(.*?)</tr>", page, re.DOTALL)
    return [
        [re.sub(r"<[^>]+>", " ", c).strip() for c in re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row)]
        for row in cells
    ]


def test_tables_hold_the_metrics(run):
    _, _, metrics, page = run
    table = rows(page)
    for name, method in metrics["methods"].items():
        quality, resolution = [row for row in table if row[0] == name]
        for cell, target in zip(quality[2:4], ("chart", "picture"), strict=True):
            found = method["targets"][target]
            assert cell == f"{found['psnr_db']:.1f} / {found['ssim']:.2f}"
        assert quality[1] == "4"
        cut_off = method["limits"]["cut_off_cycles_per_mm"]
        assert resolution[5] == f"{cut_off:.1f}"
    conventional, resolution = [row for row in table if row[0] == "conventional"]
    assert conventional[-1] == "20.3"
    assert (resolution[1], resolution[3], resolution[-1]) == ("5.00", "4.60", "10.8")
    pairs, resolution = [row for row in table if row[0] == "pairs"]
    assert (pairs[-1], resolution[3], resolution[4], resolution[-1]) == ("–", "–", "–", "–")


def test_configuration_versions_and_seed_are_shown(run):
    config, folder, _, page = run
    shown = re.search(r"<pre>(.*?)</pre>", page, re.DOTALL).group(1)
    held = (folder.path / "config.yaml").read_text("utf-8")
    assert html.unescape(shown).strip() == held.strip()
    assert f"seed {config.seed}" in page
    assert environment()["versions"]["jax"] in page


def method(psnr, published_psnr, resolved, published_resolved):
    element = None if resolved is None else {"object_mm": resolved}
    return {
        "mean_psnr_of_pictures_db": psnr,
        "targets": {"picture": {"resolved": None}, "chart": {"resolved": element}},
        "published": {"psnr_db": published_psnr, "resolved_object_mm": published_resolved},
    }


def test_findings_say_how_the_numbers_lie_to_the_published_ones(run):
    metrics = {
        "methods": {
            "better": method(24.54, 20.3, 1.0, 1.6),
            "worse": method(18.0, 20.0, 4.0, 3.2),
            "equal": method(None, None, 2.0, 2.02),
            "alone": method(20.0, None, None, None),
        }
    }
    assert findings(run[0], metrics) == [
        "better: 24.5 dB on average over the pictures, published 20.3 dB (+4.2 dB).",
        "better: resolves a line pair of 1.00 mm on the object, published 1.60 mm: finer.",
        "worse: 18.0 dB on average over the pictures, published 20.0 dB (-2.0 dB).",
        "worse: resolves a line pair of 4.00 mm on the object, published 3.20 mm: coarser.",
        "equal: resolves a line pair of 2.00 mm on the object, published 2.02 mm: the same within "
        "3 %.",
        "From finest to coarsest on the chart: better (1.00 mm), equal (2.00 mm), worse (4.00 mm).",
    ]


def test_page_of_a_run_without_a_chart(run):
    """Nothing resolved and no contrast figure: the page is still whole."""
    config, folder, metrics, _ = run
    for entry in metrics["methods"].values():
        entry["targets"]["chart"]["resolved"] = None
    (folder.path / "figures" / "contrast.png").rename(folder.path / "figures" / "contrast.away")
    page = render(config, folder, metrics, environment())
    assert page.count("<img ") == 6
    (row,) = [r for r in rows(page) if r[0] == "conventional" and len(r) == 8]
    assert row[1:3] == ["–", "–"]


@pytest.mark.thorough
def test_pixels_coarser_than_the_zones_are_told_once_here_and_on_the_terminal(tmp_path):
    out = tmp_path / "out"
    result = call("run", mini.write(tmp_path), "--out", out, "--set", "sensor.pitch=88um")
    assert result.exit_code == 0, result.output
    (line,) = result.stderr.splitlines()
    told = "the mask casts 7.73 cycles/mm on pixels that resolve 5.68 (Nyquist, 1/(2 pitch))"
    assert line.startswith(f"thincam: warning: {told}")
    page = (out / "report.html").read_text("utf-8")
    assert page.count(told) == 1
    assert f"<strong>Warning:</strong> {told}" in page
