"""The serial line: deadlines, resynchronisation, exclusive opening, and an error for each cause."""

import os
import threading
import time
import tty
from contextlib import contextmanager, suppress

import pytest

from thincam_jax.hardware.base import (
    Busy,
    Disconnected,
    NotFound,
    PermissionDenied,
    ProtocolError,
    Timeout,
)
from thincam_jax.hardware.stages import serial_link
from thincam_jax.hardware.stages.serial_link import LONGEST_LINE, SerialLink

NOBODY = 65534


@pytest.fixture
def terminal():
    """The far end of a line, and the path of the near one."""
    far, near = os.openpty()
    tty.setraw(near)
    yield far, os.ttyname(near)
    for descriptor in (far, near):
        with suppress(OSError):
            os.close(descriptor)


@pytest.fixture
def line(terminal, tmp_path):
    """The far end of a line, and the link that is open at the near one."""
    link = SerialLink("stage", terminal[1], 115200, str(tmp_path / "log" / "wire.txt"))
    yield terminal[0], link
    link.close()


@contextmanager
def as_nobody():
    """As a user who owns nothing, where the tests run as the administrator."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)


def soon(seconds: float = 1.0) -> float:
    return time.monotonic() + seconds


def test_lines_come_whole_however_their_bytes_come(line):
    far, link = line
    sender = threading.Timer(0.02, os.write, [far, b"cond\r\nthird\n"])
    os.write(far, b"first\r\nse")
    sender.start()
    assert [link.read_line(soon()) for _ in range(3)] == [b"first", b"second", b"third"]
    sender.join()


def test_half_a_line_is_a_timeout_and_its_rest_completes_it(line):
    far, link = line
    os.write(far, b"hal")
    with pytest.raises(Timeout, match="no answer in time"):
        link.read_line(soon(0.02))
    os.write(far, b"f\n")
    assert link.read_line(soon()) == b"half"


def test_a_line_that_nobody_reads_ends_in_a_timeout(line):
    _, link = line
    with pytest.raises(Timeout, match="takes no more bytes"):
        for _ in range(100):
            link.write(bytes(1 << 12), soon(0.02))


@pytest.mark.parametrize("end", [b"", b"\n"], ids=["endless", "ended"])
def test_a_long_line_is_refused_and_the_next_one_read(line, end):
    far, link = line
    os.write(far, bytes(LONGEST_LINE + 1) + end)
    with pytest.raises(ProtocolError, match="more than 512 bytes"):
        link.read_line(soon())
    link.purge()
    os.write(far, b"ok\n")
    assert link.read_line(soon()) == b"ok"


def test_purge_gives_up_on_a_device_that_does_not_stop(line, monkeypatch):
    far, link = line
    monkeypatch.setattr(serial_link, "LONGEST_PURGE", 0.05)
    done = threading.Event()

    def send():
        os.set_blocking(far, False)
        while not done.is_set():
            with suppress(BlockingIOError):
                os.write(far, bytes(100))

    sender = threading.Thread(target=send)
    sender.start()
    try:
        with pytest.raises(ProtocolError, match="does not stop sending"):
            link.purge()
    finally:
        done.set()
        sender.join()


def test_a_port_that_goes_is_disconnected_for_all_that_follows(terminal):
    far, path = terminal
    link = SerialLink("stage", path, 115200)
    with suppress(OSError):
        os.close(far)
    for use in (lambda: link.read_line(soon()), lambda: link.write(b"?", soon()), link.purge):
        with pytest.raises(Disconnected, match="stage at /dev/.*plug it in again"):
            use()
    link.close()
    link.close()
    with pytest.raises(Disconnected):
        link.read_line(soon())


def test_what_is_no_port_is_not_found_and_the_ports_are_named(tmp_path):
    (tmp_path / "file").write_text("", "utf-8")
    for path in ("absent", "file", "file/absent", "."):
        with pytest.raises(NotFound, match="ports here: "):
            SerialLink("stage", str(tmp_path / path), 115200)


def test_a_port_of_another_user_is_denied_with_the_group_to_join(terminal):
    os.chmod(terminal[1], 0)
    with as_nobody(), pytest.raises(PermissionDenied, match=r"usermod -aG \w+ \$USER.*udev rule"):
        SerialLink("stage", terminal[1], 115200)


def test_a_port_is_opened_once_and_its_holder_is_named(terminal):
    path = terminal[1]
    link = SerialLink("stage", path, 115200)
    with pytest.raises(Busy, match=rf"\(process {os.getpid()}\) holds it"):
        SerialLink("stage", path, 115200)
    link.write(b"?", soon())  # and goes on
    link.close()
    SerialLink("stage", path, 115200).close()


def test_an_unwritable_wire_log_is_reported_before_the_port_is_opened(terminal, tmp_path):
    (tmp_path / "file").write_text("", "utf-8")
    with pytest.raises(PermissionDenied, match="no wire log at .*name a file"):
        SerialLink("stage", terminal[1], 115200, str(tmp_path / "file" / "wire.txt"))
    SerialLink("stage", terminal[1], 115200).close()
