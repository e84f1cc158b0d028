"""The built documentation in headless Chromium, opened as files; skipped where one is missing."""

import shutil

import pytest

from helpers import ROOT

SITE = ROOT / "docs/_build"
PAGES = ("index", "start", "guide/masks", "guide/depth", "gallery/index", "api/thincam_jax")
PAGES += ("api/generated/thincam_jax.reconstruct", "theory/thesis", "files/index")


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if not (SITE / "index.html").exists():
        pytest.skip("docs/_build is missing: make docs")
    if (chromium := shutil.which("chromium")) is None:
        pytest.skip("chromium is not installed")
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.mark.parametrize("page", PAGES)
@pytest.mark.parametrize("width", [390, 1100, 1280])
def test_a_page_fits_and_asks_for_nothing(browser, page, width):
    """No wider than the window, the bar at most 64 pixels high, and only files are read."""
    view, asked = browser.new_page(viewport={"width": width, "height": 900}), []
    view.on("request", lambda request: asked.append(request.url))
    view.goto((SITE / f"{page}.html").as_uri())
    assert view.evaluate("document.documentElement.scrollWidth") <= width
    assert view.evaluate("document.querySelector('.bd-header').offsetHeight") <= 64
    assert not [url for url in asked if not url.startswith(("file:", "data:", "blob:"))]
    view.close()


def test_search_finds_what_is_there(browser):
    view = browser.new_page()
    view.goto((SITE / "search.html").as_uri() + "?q=fringe+scanning")
    view.wait_for_selector("#search-results li a")
    assert "FringeScanning" in view.inner_text("#search-results")
    view.close()


def test_dark_mode_and_formulas(browser):
    view = browser.new_page(color_scheme="dark")
    view.goto((SITE / "guide/depth.html").as_uri())
    view.wait_for_selector("mjx-container svg")
    colour = view.evaluate("getComputedStyle(document.body).backgroundColor")
    assert max(int(part) for part in colour.strip("rgb()").split(",")) < 64
    view.close()
