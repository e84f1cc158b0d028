"""The line that says what a long call does: seen by who waits, and by nobody else."""

import contextlib
import io
import logging
import re
import time

import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax._core import progress


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
    lines = [line.rstrip() for line in at_terminal.getvalue().split("\r") if line.strip()]
    lines = [re.sub(r"\d+ s", "… s", line) for line in lines]
    assert lines[0] == "looking, … s: compiling, if this is the first of its size"
    assert "looking, … s: step 2 of at most 10" in lines
    assert lines[-1] == "looking, … s: step 4 of at most 10, at most … s left"
    shown = at_terminal.getvalue()
    assert shown.endswith("\r") and not shown.split("\r")[-2].strip()  # the line is gone


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


def test_it_goes_where_the_call_fails(at_terminal):
    watched = progress.watched("looking")
    with pytest.raises(KeyError), contextlib.redirect_stderr(at_terminal), watched:
        time.sleep(0.1)
        raise KeyError
    assert at_terminal.getvalue().endswith("\r")


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
