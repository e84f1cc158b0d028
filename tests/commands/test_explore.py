"""`thincam explore`: its page reaches the camera, and nobody else does."""

import json
import shutil
import socket

import pytest
from commands.served import asked, assert_ctrl_c_frees, served
from commands.study import tiny
from commands.test_cli import call, one_line

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


@pytest.mark.thorough
def test_a_browser_shows_the_last_value_of_a_drag(explored, tmp_path):
    chromium = shutil.which("chromium") or pytest.skip("chromium is not installed")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    _, port, token = explored
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1100, "height": 900})
        faults = []
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("console", lambda said: faults.append(said.text) if said.type == "error" else None)
        page.goto(f"http://127.0.0.1:{port}/?token={token}")
        slider = page.locator("input[name=beta]")
        slider.wait_for()
        for value in range(10, 40):
            slider.evaluate(
                "(one, v) => { one.value = v; one.dispatchEvent(new Event('input')); }", value
            )
        shown = page.locator(".tc-explorer")
        last = """.tc-explorer[data-values*='"beta":39']"""
        page.locator(last).wait_for(timeout=60_000)
        page.locator("text=captures of").wait_for(timeout=60_000)
        assert json.loads(shown.get_attribute("data-values"))["beta"] == 39
        assert page.evaluate("document.documentElement.scrollWidth") <= 1100
        sizes = page.evaluate("[...document.images].map((one) => one.naturalWidth)")
        assert len(sizes) == 3 and min(sizes) > 20 and not faults
        browser.close()


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
