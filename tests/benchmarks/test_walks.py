"""Walks of a reader through the package, in a process without the checks of tests."""

import re
import subprocess
import sys

import pytest

from helpers import ROOT


@pytest.mark.thorough
def test_a_psf_leads_through_few_files():
    words = [sys.executable, "-W", "ignore", "benchmarks/walks.py", "psf", "--files"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT, check=True)
    counts, stays = done.stdout.splitlines()
    *_, files, found, returns = map(int, re.findall(r"\d+", counts))
    assert (len(set(stays.split())), len(stays.split())) == (files, found)
    assert found == files + returns
    assert stays.split()[0] == "lensless/psf.py"
    assert files <= 7 and returns <= 10
