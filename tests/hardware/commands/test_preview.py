"""`thincam preview` on the virtual rig: frames, controls, a browser, and devices that are freed."""

import json
import os
import shutil
from contextlib import contextmanager

import pytest
import tifffile
import yaml
from commands.served import asked, assert_ctrl_c_frees, served
from commands.test_cli import call
from hardware.commands import tiny
from hardware.memory_rig import MemoryCamera, MemoryDisplay, World

from thincam_jax.hardware.base import Busy
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


@contextmanager
def browsed(port, token):
    """The page of a preview in Chromium, with its first frame, and the faults of its script."""
    chromium = shutil.which("chromium") or pytest.skip("chromium is not installed")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page, faults = browser.new_page(viewport={"width": 1100, "height": 900}), []
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.goto(f"http://127.0.0.1:{port}/?token={token}")
        page.locator(".tc-explorer[data-count]").wait_for(timeout=60_000)
        yield page, faults
        browser.close()


@pytest.mark.thorough
def test_a_browser_shows_frame_after_frame(previewed):
    _, port, token, home = previewed
    with browsed(port, token) as (page, faults):
        place = page.locator(".tc-explorer[data-count]")
        first = int(place.get_attribute("data-count"))
        page.wait_for_timeout(3000)
        assert int(place.get_attribute("data-count")) > first + 3
        before = len(list((home / "frames").glob("*")))
        page.keyboard.press("k")
        page.locator("text=Kept as").wait_for(timeout=30_000)
        assert len(list((home / "frames").iterdir())) == before + 1
        assert page.evaluate("document.documentElement.scrollWidth") <= 1100 and not faults


@pytest.mark.thorough
def test_ctrl_c_frees_the_port(previewed):
    child, port, *_ = previewed
    assert_ctrl_c_frees(child, port)


def test_ctrl_c_frees_the_devices(tmp_path, monkeypatch):
    """Each is closed, and another process may have it."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    world, opened = World(), []

    def open_memory(kind, name, options):
        opened.append(world.open({"cameras": MemoryCamera, "displays": MemoryDisplay}[kind]))
        return opened[-1]

    def ctrl_c(shown, *_):
        shown.view()
        with pytest.raises(Busy), held("aravis {serial: 7}"):
            pass
        raise KeyboardInterrupt

    monkeypatch.setattr("thincam_jax.hardware.acquisition.rig.open_device", open_memory)
    monkeypatch.setattr("thincam_jax.hardware.commands.command.serve_page", ctrl_c)
    raw = {"name": "real", "kind": "capture", "rig": "real", "plan": {"kind": "scene"}}
    raw["camera"] = {
        "driver": "aravis", "options": {"serial": 7}, "exposure": "10 ms", "pitch": "5 um"
    }  # fmt: skip
    result = call("preview", tiny.write(tmp_path, yaml.safe_dump(raw)))
    assert result.exit_code == 130 and result.stderr == "thincam: interrupted\n"
    assert len(opened) == 2 and not any(device.here for device in opened)
    with held("aravis {serial: 7}"):
        pass


def test_a_second_preview_of_a_camera_is_told_who_has_it(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    file = tiny.write(tmp_path)
    for command in ("preview", "capture"):
        with held("aravis {serial: 7}"):
            options = ("--set", "rig=real", "--set", "camera.options={serial: 7}")
            result = call(command, file, *options)
        (line,) = result.stderr.splitlines()
        assert result.exit_code == 3 and f"(process {os.getpid()}) has held it since" in line
