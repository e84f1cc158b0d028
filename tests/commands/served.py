"""A command that serves a page, as a process, and what its page answers."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from contextlib import contextmanager

from helpers import ROOT


def asked(port, path, *, token=None, body=None, **headers):
    """Status and body of a request; `token` as the page's module sends it."""
    if token:
        headers["Authorization"] = f"Bearer {token}"
    data = None if body is None else json.dumps(body).encode()
    address = f"http://127.0.0.1:{port}{path}"
    request = urllib.request.Request(address, data, headers)
    try:
        with urllib.request.urlopen(request, timeout=120) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


@contextmanager
def served(*words, cwd=None):
    """A process of `thincam WORDS`: the process, its port and token."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    command = [sys.executable, "-m", "thincam_jax.commands.start", *map(str, words)]
    with subprocess.Popen(
        [*command, "--no-browser", "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
        cwd=cwd,
    ) as child:
        assert child.stdout is not None
        address = json.loads(child.stdout.readline())["address"]
        port, token = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/\?token=([\w-]+)", address).groups()
        yield child, int(port), token
        child.kill()


def assert_ctrl_c_frees(child, port):
    """Ctrl-C ends the process in one line, and its port can be taken."""
    child.send_signal(signal.SIGINT)
    _, told = child.communicate(timeout=60)
    assert (child.returncode, told) == (130, "thincam: interrupted\n")
    with socket.socket() as own:
        own.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        own.bind(("127.0.0.1", port))
