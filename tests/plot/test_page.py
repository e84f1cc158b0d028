"""The server of the pages: hostile requests are refused in one line and hold nothing."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading

import pytest

from helpers import ROOT
from thincam_jax._core.controls import Control, turned

uvicorn = pytest.importorskip("uvicorn")
pytest.importorskip("starlette")
page = pytest.importorskip("thincam_jax.plot.page")


class Shown:
    """Two numbers and no picture."""

    controls = (Control("a", "a", "mm", 0.0, 9.0, 1.0), Control("b", "b", "mm", 0.0, 9.0, 1.0))
    captions, live = {}, False

    def turn(self, values):
        self.values = turned(self.controls, {name: float(value) for name, value in values.items()})

    def view(self, *, rest=True):
        return self

    def message(self):
        return json.dumps({"values": self.values}), []


@pytest.fixture(scope="module")
def address():
    """Port and token of a page that is served while the tests run, with a patience of 0.3 s."""
    found, ready, servers = [], threading.Event(), []

    class Kept(uvicorn.Server):
        def __init__(self, config):
            super().__init__(config)
            servers.append(self)

    def announced(at):
        found.append((int(at.split(":")[2].split("/")[0]), at.split("=")[1]))
        ready.set()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(uvicorn, "Server", Kept)
        patch.setattr(page, "_PATIENCE", 0.3)
        serve = threading.Thread(target=page.serve, args=(Shown(), "tiny", 0, announced, False))
        serve.start()
        assert ready.wait(30)
        yield found[0]
        servers[0].should_exit = True
        serve.join(30)
        assert not serve.is_alive()


def answer(port, *parts):
    """All that comes back until the server closes; parts are sent one after the other."""
    with socket.create_connection(("127.0.0.1", port), timeout=30) as own:
        found = b""
        try:
            for part in parts:
                own.sendall(part)
            while got := own.recv(2**16):
                found += got
        except (ConnectionResetError, BrokenPipeError):
            pass
        return found


def head(token, *lines):
    asked = "POST /view HTTP/1.1", "Host: 127.0.0.1:{}", f"Authorization: Bearer {token}", *lines
    return lambda port: "\r\n".join((*asked, "", "")).format(port).encode()


def viewed(address, body, length=None):
    port, token = address
    length = len(body) if length is None else length
    return answer(port, head(token, f"Content-Length: {length}")(port), body)


def test_every_answer_is_kept_by_nobody_and_is_what_it_says(address):
    port, token = address
    gets = [f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n" for path in ("/", "/none")]
    told = [
        answer(port, get.encode()) for get in (*gets, gets[0].replace("/ ", f"/?token={token} "))
    ]
    told.append(viewed(address, b'{"values": {"a": 2}, "rest": true}'))
    told.append(viewed(address, b"["))
    assert [int(one.split()[1]) for one in told] == [403, 404, 200, 200, 400]
    for one in told:
        lower = one.lower()
        assert b"cache-control: no-store" in lower and b"x-content-type-options: nosniff" in lower
    assert told[3].endswith(b'{"values": {"a": 2.0}}')


@pytest.mark.parametrize(
    ("body", "text"),
    [
        (b"[" * 9000, b"nested too deeply"),
        (b'{"values": {"a": ' + b"9" * 400 + b'}, "rest": true}', b"too large"),
        (b'{"values": {"a": ' + b"9" * 5000 + b'}, "rest": true}', b"4300"),
        (rb'{"values": {"\ud800": 1}, "rest": true}', rb"\ud800"),
        (b'{"values": {"a": NaN}, "rest": true}', b"a is NaN"),
        (b'{"values": 5, "rest": true}', b"int"),
        (b"\xff\xfe\x00", b"decode"),
        (b"x" * 10_001, b"too long"),
    ],
)
def test_a_hostile_body_is_refused_in_a_line(address, body, text, capfd):
    told = viewed(address, body)
    assert told.startswith(b"HTTP/1.1 400 ") and text in told, told
    printed = capfd.readouterr()
    assert printed.out + printed.err == ""


def test_a_chunked_body_is_refused_while_it_is_read(address):
    """Before its end, whatever its `Content-Length` says."""
    port, token = address
    start = head(token, "Content-Length: 5", "Transfer-Encoding: chunked")(port)
    told = answer(port, start + b"4000\r\n" + b"x" * 0x4000 + b"\r\n")
    assert told.startswith(b"HTTP/1.1 400 ") and told.endswith(b"the request is too long")


@pytest.mark.parametrize("said", [b"", b"GET / HT", b"POST /view HTTP/1.1\r\nHost: x\r\n"])
def test_a_connection_without_a_request_is_ended(address, said, capfd):
    assert answer(address[0], said) == b""
    assert answer(address[0], b"\x16\x03\x01\x02").startswith(b"HTTP/1.1 400 ")
    assert capfd.readouterr().err == ""


SERVED = """
import sys
from thincam_jax.plot.page import serve
sys.path.insert(0, {folder!r})
from plot.test_page import Shown
serve(Shown(), "tiny", 0, lambda at: print(at, flush=True), False)
"""


@pytest.mark.thorough
def test_ctrl_c_does_not_wait_for_half_a_request():
    """Of its patience, 10 s here, nothing is waited for; a connection and a request are open."""
    paths = os.pathsep.join(map(str, (ROOT, ROOT / "tests")))
    with subprocess.Popen(
        [sys.executable, "-c", SERVED.format(folder=str(ROOT / "tests"))],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": paths},
    ) as child:
        assert child.stdout is not None
        at = child.stdout.readline()
        port, token = int(at.split(":")[2].split("/")[0]), at.strip().split("=")[1]
        with (
            socket.create_connection(("127.0.0.1", port)),
            socket.create_connection(("127.0.0.1", port)) as half,
        ):
            half.sendall(head(token, "Content-Length: 400")(port) + b"12345")
            assert answer(port, b"GET / HTTP/1.1\r\nHost: x\r\n\r\n").startswith(b"HTTP/1.1 403 ")
            child.send_signal(signal.SIGINT)
            _, told = child.communicate(timeout=8)
    assert "KeyboardInterrupt" in told and "Cancel 1" not in told and "ASGI" not in told
