import os
import subprocess
import sys

from thincam_jax.hardware.holder import holder


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
