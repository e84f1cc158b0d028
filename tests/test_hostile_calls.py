"""Public functions with arguments that nobody should give: one clear line, or a sound result."""

import os
import subprocess
import sys

import pytest

from helpers import ROOT


def search(count, seed):
    """In a process of its own, without the checks of types that tests have and users have not."""
    command = [sys.executable, str(ROOT / "tests" / "hostile_calls.py"), str(count), str(seed)]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, env=env, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-2000:]


def test_errors_are_a_line_of_ours_and_nan_has_a_status():
    search(40, 1)


@pytest.mark.thorough
def test_many_more_calls():
    search(4_000, 2)  # some ten minutes of one core
