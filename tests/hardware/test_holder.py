import os
import subprocess
import sys

import pytest

from thincam_jax.hardware.base import Busy
from thincam_jax.hardware.holder import held, holder

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


def test_without_a_place_for_locks_devices_are_not_held(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "file"))
    with held("eye"), held("eye"):
        pass
