"""The built documentation in headless Chromium, opened as files; skipped where one is missing."""

import shutil

import pytest

from helpers import ROOT

SITE = ROOT / "docs/_build"
PAGES = sorted(page.relative_to(SITE).as_posix() for page in SITE.rglob("*.html"))
PAGES = [page for page in PAGES if not page.startswith("_static/")]  # the theme's own
NAME = "api/generated/"  # a page for each name of the reference


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


@pytest.fixture(scope="module")
def view(browser):
    """A page that lists requests and faults; a site that is not built is skipped, not passed."""
    view = browser.new_page()
    view.asked, view.faults = [], []
    view.on("request", lambda request: view.asked.append(request.url))
    view.on("pageerror", lambda error: view.faults.append(str(error)))
    view.on("console", lambda said: said.type == "error" and view.faults.append(said.text))
    return view


def fits(view, page, *widths):
    """No wider than a phone or a screen, the bar at most 64 pixels high; only files are read."""
    view.asked.clear()
    view.faults.clear()
    for width in widths:
        view.set_viewport_size({"width": width, "height": 900})
        if width == widths[0]:
            view.goto((SITE / page).as_uri())
        assert view.evaluate("document.documentElement.scrollWidth") <= width
        assert view.evaluate("document.querySelector('.bd-header').offsetHeight") <= 64
    assert not [url for url in view.asked if not url.startswith(("file:", "data:", "blob:"))]
    assert not view.faults, page


@pytest.mark.parametrize("page", [p for p in PAGES if NAME not in p] or ["index.html"])
def test_a_page_fits_and_asks_for_nothing(view, page):
    fits(view, page, 390, 1100, 1280)


@pytest.mark.thorough
def test_every_name_of_the_reference_fits_a_phone(view):
    """The column of text is wider on a screen, and the bar that of all pages."""
    names = [page for page in PAGES if NAME in page]
    assert len(names) > 150  # nearly one for each of the names that docs/api promises
    for page in names:
        fits(view, page, 390)


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
