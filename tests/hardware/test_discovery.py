"""Devices: what is found by looking, and who holds one."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
from commands.test_cli import call, called, one_line

from thincam_jax.hardware import registry
from thincam_jax.hardware.base import Busy, Connected, Device, NotFound
from thincam_jax.hardware.cameras import aravis
from thincam_jax.hardware.holder import held, holder
from thincam_jax.hardware.virtual.grbl import VirtualGrbl
from thincam_jax.hardware.virtual.zaber import VirtualZaber


def test_cameras_of_aravis_are_listed_by_their_names(monkeypatch):
    """By a double of aravis' list, which is looked up anew."""
    names = ["FLIR-Blackfly S BFS-U3-51S5M-22541873", "Aravis-Fake-1"]
    listed: list[str] = []
    double = SimpleNamespace(
        update_device_list=lambda: listed.extend(names),
        get_n_devices=lambda: len(listed),
        get_device_id=lambda n: listed[n],
        get_device_vendor=lambda n: listed[n].split("-")[0],
        get_device_model=lambda n: listed[n].split("-")[1],
    )
    monkeypatch.setattr(aravis, "_libraries", lambda: (double, None))
    first, second = aravis.AravisCamera.connected()
    assert str(first) == f"camera aravis {{name: {names[0]}}}: FLIR Blackfly S BFS"
    assert aravis.AravisCamera.Options(**second.options).name == names[1]


def test_cameras_of_pylon_and_monitors(monkeypatch):
    monkeypatch.setenv("PYLON_CAMEMU", "2")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    found = registry.connected_devices()
    assert sum(one.driver == "pylon" for one in found) >= 1
    (monitor,) = (one for one in found if one.driver == "sdl")
    assert "pixels" in monitor.about and "at x 0, y 0" in monitor.about
    assert str(monitor).startswith("display sdl {monitor: ")


class Noted(VirtualZaber):
    received = b""

    def _receive(self, data):
        self.received += data
        super()._receive(data)


class NotedGrbl(VirtualGrbl):
    received = b""

    def _receive(self, data):
        self.received += data
        super()._receive(data)


def test_a_zaber_stage_answers_and_stays_as_it_is():
    with Noted() as stage:
        place, port = stage.true_position, str(stage.port)
        (found,) = registry.ask_port(port)
        assert (found.driver, dict(found.options)) == ("zaber", {"port": port, "device": 1})
        assert found.about == "serial 12345"
        assert stage.true_position == place and not stage._sends_checksums
        assert set(stage.received.split()) <= {b"?", b"/get", b"system.serial"}
        with registry.open_device("stages", "zaber", found.options) as opened:
            assert opened.identity.serial == "12345"
            with pytest.raises(Busy):
                registry.ask_port(port)


def test_a_grbl_machine_reports_its_state():
    with NotedGrbl() as stage:
        place = stage.true_position
        (found,) = registry.ask_port(str(stage.port))
        assert found.driver == "grbl" and ("Grbl" in found.about or "state" in found.about)
        assert stage.true_position == place
        assert set(stage.received.split()) <= {b"?"}


def test_a_driver_of_another_package_finds_its_own(monkeypatch):
    class Eye(Device):
        @classmethod
        def connected(cls):
            return [Connected("camera", "eye", {"serial": "7"}, "Elsewhere Eye")]

    monkeypatch.setattr(registry, "drivers", lambda kind: {"eye": ""} if kind == "cameras" else {})
    monkeypatch.setattr(registry, "driver", lambda kind, name: Eye)
    ports = [SimpleNamespace(device="/dev/ttyUSB0", description="USB serial")]
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: ports)
    result = called("doctor", "--devices")
    lines = result.stdout.splitlines()
    assert "camera eye {serial: 7}: Elsewhere Eye" in lines
    assert "serial port {port: /dev/ttyUSB0}: USB serial" in lines


HOLD = """\
import sys
from thincam_jax.hardware.holder import held
with held(sys.argv[1]):
    print(flush=True)
    sys.stdin.read()
"""


def test_the_process_that_has_a_file_open_is_named(tmp_path):
    path = tmp_path / "device"
    path.touch()
    code = "import sys; file = open(sys.argv[1]); print(flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", code, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert f"(process {process.pid})" in holder(str(path), others=True)
        process.communicate()
    assert holder(str(path)) == "another program"
    with path.open():
        assert f"(process {os.getpid()})" in holder(str(path))
        assert holder(str(path), others=True) == "another program"


def test_a_device_is_held_by_one_process_until_that_ends(tmp_path, monkeypatch):
    """Also one that is killed; other devices are free."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    command = [sys.executable, "-c", HOLD, "eye {serial: 1}"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        who = rf"eye .serial: 1.: open: .* \(process {process.pid}\) has held it since \d\d:\d\d"
        with pytest.raises(Busy, match=who), held("eye {serial: 1}"):
            pass
        with held("eye {serial: 2}"):
            pass
        process.kill()
    with held("eye {serial: 1}"), pytest.raises(Busy, match=str(os.getpid())):
        with held("eye {serial: 1}"):
            pass


def test_nothing_and_no_port(tmp_path):
    with pytest.raises(NotFound):
        registry.ask_port(str(tmp_path / "none"))
    assert "no serial port that works" in one_line(call("doctor", "--ask", tmp_path / "none"))


def test_without_a_place_for_locks_devices_are_not_held(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "file"))
    with held("eye"), held("eye"):
        pass
