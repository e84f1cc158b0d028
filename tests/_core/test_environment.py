"""What a bug report needs, memory before it is taken, and progress that is shown."""

import contextlib
import io
import logging
import re
import time

import jax
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax._core import environment as installation
from thincam_jax._core import memory, progress


def test_precisions_with_and_without_float64():
    assert installation.dtype_support() == dict.fromkeys(
        ("float32", "complex64", "float64", "complex128"), "yes"
    )
    with jax.enable_x64(False):
        support = installation.dtype_support()
    assert support["float32"] == support["complex64"] == "yes"
    assert support["float64"] == support["complex128"] == "off; set JAX_ENABLE_X64=1"


def test_precision_that_the_device_refuses(monkeypatch):
    def refuse(_):
        raise RuntimeError("not on this device")

    monkeypatch.setattr(installation.jnp.fft, "fft", refuse)
    assert installation.dtype_support()["float32"] == "no (RuntimeError)"


def test_compiler_that_adds_up_wrong_is_told(monkeypatch):
    """As jaxlib 0.10.2 does."""
    assert installation.compiled_sums() == "right"
    mean = installation._of_channels

    def compiled_wrong(response, capture, noise):
        right = mean(response, capture, noise)
        return right if isinstance(response, np.ndarray) else 1.001 * right

    monkeypatch.setattr(installation, "_of_channels", compiled_wrong)
    assert installation.compiled_sums().startswith("WRONG; install another jaxlib")


def test_refuses_with_both_numbers(monkeypatch):
    monkeypatch.setattr(memory, "available_bytes", lambda: 3 * 2**30)
    with pytest.raises(
        MemoryError, match=r"^a cube needs about 4.5 GiB, 3.0 GiB are free; halve it$"
    ):
        memory.refuse_if_too_large("a cube", int(4.5 * 2**30), "halve it")
    memory.refuse_if_too_large("a cube", 3 * 2**30, "halve it")


def test_free_memory_that_cannot_be_told_refuses_nothing(monkeypatch):
    monkeypatch.setattr(memory, "available_bytes", lambda: None)
    memory.refuse_if_too_large("a cube", 10**30, "halve it")


def test_free_memory_of_this_machine():
    """Between 10 MiB and 100 TiB, if it can be told at all: bytes, not pages or kilobytes."""
    free = memory.available_bytes()
    assert free is None or 10 * 2**20 < free < 100 * 2**40


def test_the_cache_of_files_is_free_memory(monkeypatch):
    """A file of gigabytes that was just written would leave none: pages that hold it are not."""
    lines = "MemTotal: 9 kB\nMemFree: 10 kB\nMemAvailable: 3000 kB\n"
    monkeypatch.setattr(memory.Path, "read_text", lambda path, encoding: lines)
    assert memory.available_bytes() == 3000 * 1024


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def at_terminal(monkeypatch):
    for name in ("_PATIENCE", "_OFTEN", "_SELDOM"):
        monkeypatch.setattr(progress, name, 0.01)
    monkeypatch.delenv("THINCAM_PROGRESS", raising=False)
    return Terminal()


def test_it_counts_and_goes(at_terminal):
    with contextlib.redirect_stderr(at_terminal), progress.watched("looking") as tell:
        time.sleep(0.1)
        tell(2, 10)
        time.sleep(0.1)
        tell(4, 10)
        time.sleep(0.1)
        tell(5, 10, "half of it is known")
        time.sleep(0.1)
    lines = [line.rstrip() for line in at_terminal.getvalue().split("\r") if line.strip()]
    lines = [re.sub(r"\d+ s", "… s", line) for line in lines]
    assert lines[0] == "looking, … s: compiling, if this is the first of its size"
    assert "looking, … s: step 2 of at most 10" in lines
    assert "looking, … s: step 4 of at most 10, at most … s left" in lines
    assert lines[-1] == "looking, … s: half of it is known"
    shown = at_terminal.getvalue()
    assert shown.endswith("\r") and not shown.split("\r")[-2].strip()  # the line is gone


def test_it_goes_where_the_call_fails(at_terminal):
    watched = progress.watched("looking")
    with pytest.raises(KeyError), contextlib.redirect_stderr(at_terminal), watched:
        time.sleep(0.1)
        raise KeyError
    assert at_terminal.getvalue().endswith("\r")


def test_what_is_quick_or_within_another_call_shows_nothing(at_terminal, monkeypatch):
    inner = progress.watched("inner")(time.sleep)
    with contextlib.redirect_stderr(at_terminal), progress.watched("outer"):
        inner(0.1)
    assert "outer" in at_terminal.getvalue() and "inner" not in at_terminal.getvalue()
    at_terminal.truncate(0)
    monkeypatch.setattr(progress, "_PATIENCE", 10.0)
    with contextlib.redirect_stderr(at_terminal):
        inner(0.1)
        monkeypatch.setattr(progress, "_PATIENCE", 0.01)
        monkeypatch.setenv("THINCAM_PROGRESS", "off")
        inner(0.1)
    assert not at_terminal.getvalue().strip("\0")


def test_elsewhere_it_is_logged(at_terminal, monkeypatch, caplog):
    monkeypatch.setattr(Terminal, "isatty", lambda self: False)
    watched = progress.watched("looking")
    with caplog.at_level(logging.INFO), contextlib.redirect_stderr(at_terminal), watched:
        time.sleep(0.1)
    assert caplog.messages[0].startswith("looking, 0 s: compiling")
    assert not at_terminal.getvalue()


def test_a_psf_is_watched(at_terminal):
    """Of a size that no other test has: it is compiled, with what is said then."""
    mask = tc.FresnelZoneAperture(beta=25.0, width=1.6, profile="binary", harmonics=3)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 260), 0.02), distance=5.0)
    with contextlib.redirect_stderr(at_terminal):
        tc.psf(camera, wavelength=5e-4)
    assert re.search(r"computing the PSF, \d+ s: compiling", at_terminal.getvalue())


def test_a_reconstruction_is_watched(at_terminal):
    """With its iterations; a callback of the user's sees them, too, and stops it."""
    psf = np.random.default_rng(0).random((9, 9))
    recording = tc.Recording(np.random.default_rng(1).random((1, 24, 32)), tc.Psfs(psf[None]))
    seen = []

    def callback(step):
        seen.append(step.iteration)
        time.sleep(0.05)
        return step.iteration >= 20

    with contextlib.redirect_stderr(at_terminal):
        result = tc.reconstruct(recording, tc.AdmmTV(iterations=50), callback=callback)
    assert result.status == "stopped" and seen[-1] == 20
    assert re.search(r"reconstructing, \d+ s: step 20 of at most 50", at_terminal.getvalue())


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0 bytes"), (1023, "1023 bytes"), (1024, "1.0 KiB"), (3 * 2**39, "1.5 TiB")],
)
def test_readable(count, text):
    assert memory.readable(count) == text
