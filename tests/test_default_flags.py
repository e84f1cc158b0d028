"""Samples of the suite as users run it: with XLA's own flags, and for older processors."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from helpers import ROOT

pytestmark = pytest.mark.skipif(
    not os.environ.get("XLA_FLAGS"), reason="these tests have XLA's own flags"
)


def passes(flags, arguments):
    env = {**os.environ, "XLA_FLAGS": flags, "JAX_DISABLE_MOST_OPTIMIZATIONS": "0"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=env, cwd=ROOT)
    assert done.returncode == 0, done.stdout[-2000:]
    assert " passed" in done.stdout


SAMPLES = [
    "tests/lensless/propagation/test_closed_form.py::test_is_the_thesis_formula[6.5-inf]",
    "tests/imaging/operators/test_crop_convolution.py"
    "::test_it_is_the_integral_over_the_field[sensor1-field1]",
]
SOLVED = ["tests/reconstruction/test_splittings.py::test_single_precision_and_gradients[1]"]


@pytest.mark.parametrize("sample", [SAMPLES, pytest.param(SOLVED, marks=pytest.mark.thorough)])
def test_a_sample_passes_with_default_flags(sample):
    """Propagation and an operator; a step of ADMM with its gradient: others are unoptimised."""
    passes("", sample)


def has_avx512() -> bool:
    try:
        return "avx512f" in Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return False


@pytest.mark.thorough
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="these sets are of x86")
@pytest.mark.parametrize("instructions", ["SSE4_2", "AVX2"])
def test_digits_are_kept_by_each_instruction_set(instructions):
    """Phases of 1e5 rad and more, and rays at grazing angles: SSE4.2 has no fused multiply-add."""
    if instructions == "AVX2" and not has_avx512():
        pytest.skip("other tests run with the same instructions")
    rays, shadows = "test_points and float64 and 89.9999", "test_value and geometric and 1e6"
    passes(
        f"--xla_cpu_max_isa={instructions}",
        [
            "tests/_core/test_precision.py",
            "tests/waveguide/test_extremes.py",
            "tests/test_extremes.py",
            *("-m", "", "-k", f"test_phasor_has_all or {rays} or {shadows} and float32"),
        ],
    )
