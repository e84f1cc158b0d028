"""`thincam preview` on the virtual rig: frames, controls, a browser, and devices that are freed."""

import json
import os
import shutil

import pytest
import tifffile
from commands.capture import tiny
from commands.served import asked, assert_ctrl_c_frees, served
from commands.test_cli import call, one_line

from thincam_jax.hardware.holder import held

pytest.importorskip("starlette")


@pytest.fixture(scope="module")
def previewed(tmp_path_factory):
    """A process that previews the tiny rig: the process, its port and token, its folder."""
    home = tmp_path_factory.mktemp("preview")
    with served("preview", tiny.write(home), cwd=home) as found:
        yield *found, home


def frame(port, token, values, keep=False):
    """The header of the next frame."""
    body = {"values": values, "rest": keep}
    status, content = asked(port, "/view", token=token, body=body)
    assert status == 200, content
    return json.JSONDecoder().raw_decode(content.decode("latin-1"))[0]


@pytest.mark.thorough
def test_frames_follow_the_controls(previewed):
    _, port, token, home = previewed
    first = frame(port, token, {})
    assert first["names"] == ["frame", "image"]
    level = [
        float(frame(port, token, {"exposure": ms})["lines"][0].split("%")[0]) for ms in (5.0, 10.0)
    ]
    assert 1.6 < level[1] / level[0] < 2.4
    other = frame(port, token, {"pattern": 1.0})
    assert other["names"] == ["frame"] and other["values"]["pattern"] == 1.0
    assert "Kept as frames/" in frame(port, token, {}, keep=True)["lines"][-1]
    (kept,) = (home / "frames").iterdir()
    assert tifffile.imread(kept).shape == (64, 96)
    assert asked(port, "/view", body={"values": {}, "rest": False})[0] == 403
    status, told = asked(port, "/view", token=token, body={"values": {"aim": 1}, "rest": False})
    assert status == 400 and b"control" in told


@pytest.mark.thorough
def test_a_browser_shows_frame_after_frame(previewed):
    chromium = shutil.which("chromium") or pytest.skip("chromium is not installed")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    _, port, token, home = previewed
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1100, "height": 900})
        faults = []
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.goto(f"http://127.0.0.1:{port}/?token={token}")
        place = page.locator(".tc-explorer[data-count]")
        place.wait_for(timeout=60_000)
        first = int(place.get_attribute("data-count"))
        page.wait_for_timeout(3000)
        assert int(place.get_attribute("data-count")) > first + 3
        page.locator("input[name=exposure]").evaluate(
            "(one) => { one.value = 4; one.dispatchEvent(new Event('input')); }"
        )
        page.locator(""".tc-explorer[data-values*='"exposure":4']""").wait_for(timeout=30_000)
        before = len(list((home / "frames").glob("*")))
        page.keyboard.press("k")
        page.locator("text=Kept as").wait_for(timeout=30_000)
        assert len(list((home / "frames").iterdir())) == before + 1
        assert page.evaluate("document.documentElement.scrollWidth") <= 1100 and not faults
        browser.close()


@pytest.mark.thorough
def test_ctrl_c_frees_the_port(previewed):
    child, port, *_ = previewed
    assert_ctrl_c_frees(child, port)


def test_a_second_preview_of_a_camera_is_told_who_has_it(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    file = tiny.write(tmp_path)
    for command in ("preview", "capture"):
        with held("usb3_vision {serial: 7}"):
            options = ("--set", "rig=real", "--set", "camera.options={serial: 7}")
            result = call(command, file, *options)
        (line,) = result.stderr.splitlines()
        assert result.exit_code == 3 and f"(process {os.getpid()}) has held it since" in line


def test_files_of_another_kind_and_devices_that_are_not_there(tmp_path):
    assert "is missing" in one_line(call("preview", tmp_path / "no.yaml"))
    result = call("preview", tiny.write(tmp_path), "--set", "camera.driver=kodak", "--no-browser")
    assert result.exit_code == 3 and "there is no virtual one" in result.stderr
