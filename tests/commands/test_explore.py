"""`thincam explore`: its page reaches the camera, and nobody else does."""

import json
import shutil
import socket

import numpy as np
import pytest
from commands.served import asked, assert_ctrl_c_frees, served
from commands.study import tiny
from commands.test_cli import call, one_line

import thincam_jax as tc

pytest.importorskip("starlette")


@pytest.fixture(scope="module")
def explored(tmp_path_factory):
    """A process that serves the tiny study: the process, its port and token."""
    with served("explore", tiny.write(tmp_path_factory.mktemp("explore"))) as found:
        yield found


VALUES = {"values": {"beta": 22.0}, "rest": False}


@pytest.mark.thorough
def test_only_the_page_of_the_printed_address_is_answered(explored):
    _, port, token = explored
    assert len(token) >= 43  # 256 bits
    status, page = asked(port, f"/?token={token}")
    assert status == 200 and token.encode() in page and b'"beta"' in page
    assert asked(port, f"/explorer.js?token={token}")[0] == 200
    status, content = asked(port, "/view", token=token, body=VALUES)
    header, _ = json.JSONDecoder().raw_decode(content.decode("latin-1"))
    assert status == 200 and header["values"]["beta"] == 22.0
    own = {"Origin": f"http://127.0.0.1:{port}"}
    assert asked(port, "/view", token=token, body=VALUES, **own)[0] == 200
    for refused in (
        asked(port, "/"),
        asked(port, "/?token=x"),
        asked(port, "/explorer.js"),
        asked(port, "/view", body=VALUES),
        asked(port, "/view", token="x", body=VALUES),
        asked(port, "/view", token=token, body=VALUES, Origin="http://evil.example"),
        asked(port, f"/?token={token}", Host="evil.example"),
        asked(port, f"/?token={token}", Host=f"localhost.evil.example:{port}"),
    ):
        assert refused[0] == 403 and token.encode() not in refused[1]
    for path in ("/../etc/passwd", "/%2e%2e/pyproject.toml", "/docs", "/openapi.json"):
        assert asked(port, f"{path}?token={token}")[0] == 404
    for wrong in ({}, [], {"values": {"beta": "x"}, "rest": False}, {"values": {"no": 1}}):
        status, told = asked(port, "/view", token=token, body=wrong)
        assert status == 400 and b"Traceback" not in told
    long = {"values": {}, "rest": "x" * 20_000}
    assert asked(port, "/view", token=token, body=long) == (400, b"the request is too long")


@pytest.fixture(scope="module")
def shown(explored):
    """A browser's page of the explorer, with the faults that it has reported."""
    chromium = shutil.which("chromium") or pytest.skip("chromium is not installed")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    _, port, token = explored
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1100, "height": 900})
        page.faults = []
        page.on("pageerror", lambda error: page.faults.append(str(error)))
        page.on("console", lambda said: said.type == "error" and page.faults.append(said.text))
        page.add_init_script(COUNTED)
        page.goto(f"http://127.0.0.1:{port}/?token={token}")
        page.locator("text=captures of").wait_for(timeout=60_000)
        yield page
        browser.close()


# Requests on their way, the most of them and all; those that a test names come back late.
COUNTED = """
    const sent = window.fetch, seen = (window.seen = { now: 0, most: 0, all: [], late: 0 });
    window.fetch = async (address, how) => {
        seen.now += 1;
        seen.most = Math.max(seen.most, seen.now);
        const body = JSON.parse(how.body), late = !body.rest && seen.late-- > 0;
        seen.all.push(body);
        try {
            const answer = await sent(address, how);
            if (late) await new Promise((done) => setTimeout(done, 1500));
            return answer;
        } finally {
            seen.now -= 1;
        }
    };"""
MOVE = "(one, v) => { one.value = v; one.dispatchEvent(new Event('input')); }"
# Grey levels of the first picture, as the browser shows it.
LEVELS = """
    const [one] = document.images, { naturalWidth: width, naturalHeight: height } = one;
    const context = new OffscreenCanvas(width, height).getContext("2d");
    context.drawImage(one, 0, 0);
    const levels = context.getImageData(0, 0, width, height).data;
    return Array.from({ length: height }, (_, y) =>
        Array.from({ length: width }, (_, x) => levels[4 * (y * width + x)]));"""


RESTS = "seen.now === 0 && !document.querySelector('.tc-stale') && document.images[0].complete"


def wait_until(page, expression):
    """As `wait_for_function`, which the page's policy refuses."""
    for _ in range(600):
        if page.evaluate(expression):
            return
        page.wait_for_timeout(100)
    raise TimeoutError(expression)


def levels_of(page):
    return np.array(page.evaluate(f"() => {{ {LEVELS} }}"), float)


def expected(beta):
    """The PSF of the tiny study's first camera with another β, as grey levels."""
    mask = tc.FresnelZoneAperture(beta, width=2.0)
    camera = tc.LenslessCamera(mask, tc.Sensor((48, 64), 0.04), distance=3.0)
    light = {"wavelength": 500e-6, "object_distance": 100.0}
    h = np.asarray(tc.psf(camera, pixel_integration=True, **light))
    return 255 * h / h.max()


@pytest.mark.thorough
def test_a_browser_shows_the_last_value_of_a_drag(shown):
    slider = shown.locator("input[name=beta]")
    for value in range(10, 40):
        slider.evaluate(MOVE, value)
    shown.locator(""".tc-explorer[data-values*='"beta":39']""").wait_for(timeout=60_000)
    shown.locator("text=captures of").wait_for(timeout=60_000)
    assert json.loads(shown.locator(".tc-explorer").get_attribute("data-values"))["beta"] == 39
    assert shown.evaluate("document.documentElement.scrollWidth") <= 1100
    sizes = shown.evaluate("[...document.images].map((one) => one.naturalWidth)")
    assert len(sizes) == 3 and min(sizes) > 20 and not shown.faults
    assert not shown.locator(".tc-empty").count()  # which say "compiling…"


@pytest.mark.thorough
def test_a_browser_shows_the_psf_of_the_camera(shown):
    """While a slider moves as a JPEG; at rest to the grey level."""
    wait_until(shown, RESTS)
    shown.evaluate("window.kept = setTimeout; void (window.setTimeout = () => 0)")  # no rest
    shown.locator("input[name=beta]").evaluate(MOVE, 17.0)
    shown.locator(""".tc-explorer[data-values*='"beta":17']""").wait_for()
    wait_until(shown, "document.images[0].complete")
    assert shown.locator(".tc-stale").count() == 2
    error = levels_of(shown) - expected(17.0)
    assert 0 < np.sqrt(np.mean(error**2)) < 6
    shown.evaluate("void (window.setTimeout = kept)")
    shown.locator("input[name=beta]").evaluate(MOVE, 18.0)
    wait_until(shown, f"seen.all.at(-1).rest && {RESTS}")
    np.testing.assert_allclose(levels_of(shown), expected(18.0), atol=0.51)
    assert not shown.faults


@pytest.mark.thorough
def test_ctrl_c_frees_the_port(explored):
    child, port, _ = explored
    assert_ctrl_c_frees(child, port)


def test_what_cannot_be_explored(tmp_path):
    file = tiny.write(tmp_path)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        line = one_line(call("explore", file, "--port", port, "--no-browser"))
    assert line == f"--port {port}: Address already in use; give another, or leave it out"
    assert "is missing" in one_line(call("explore", tmp_path / "no.yaml"))
    for port in ("-1", "70000"):
        refused = call("explore", file, "--port", port, "--no-browser")
        assert refused.exit_code == 2 and "Invalid value for '--port'" in refused.stderr
