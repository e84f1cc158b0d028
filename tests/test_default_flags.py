"""A sample of the suite as users run it: with XLA's own flags, optimised and with its emitters."""

import os
import subprocess
import sys

import pytest

from helpers import ROOT

# Propagation, an operator, a step of ADMM with its gradient: what others compile unoptimised.
SAMPLE = (
    "tests/lensless/propagation/test_closed_form.py::test_is_the_thesis_formula[6.5-inf]",
    "tests/imaging/operators/test_crop_convolution.py"
    "::test_it_is_the_integral_over_the_field[sensor1-field1]",
    "tests/reconstruction/test_splittings.py::test_single_precision_and_gradients[1]",
)


@pytest.mark.skipif(not os.environ.get("XLA_FLAGS"), reason="these tests have XLA's own flags")
def test_a_sample_passes_with_default_flags():
    env = {**os.environ, "XLA_FLAGS": ""}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *SAMPLE]
    done = subprocess.run(command, capture_output=True, text=True, env=env, cwd=ROOT)
    assert done.returncode == 0, done.stdout[-2000:]
    assert " passed" in done.stdout
