"""What every test runs with: float64, strict dtype promotion, checked types, no display."""

import atexit
import gc
import os
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # set it to run the tests on another device
os.environ["MPLBACKEND"] = "Agg"
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # of programs that are loaded, not compiled
os.environ["THINCAM_CACHE"] = "off"  # commands in tests leave no compiled programs with the user
# There is a worker for each core: more threads in NumPy and XLA would wait busily for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Most of the tests' time goes into compiling some 14,000 small programs. Without these emitters and
# LLVM's optimisation, and with each program in one piece, it is a third of the time. What tests
# rounding is compiled `helpers.AS_IN_USE`; tests/test_default_flags.py runs a sample without flags.
# Releases after 0.10 have one kind of emitter, and end the process at the flag that chooses it.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_cpu_use_fusion_emitters=false " * version("jaxlib").startswith("0.10.")
    + "--xla_cpu_parallel_codegen_split_count=1 --xla_cpu_multi_thread_eigen=false",
)
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1" if os.environ["XLA_FLAGS"] else "0")

# JAX shortens tracebacks also of errors that are caught.
os.environ.setdefault("JAX_TRACEBACK_FILTERING", "off")

import jax
import jaxtyping
import pytest
from checked_types import checked

from helpers import ROOT

# Imports make hardly any garbage, and looking for it is a third of their time. Nor is it looked for
# again in what the process ends with.
gc.disable()
atexit.register(gc.freeze)

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_traceback_in_locations_limit", 0)  # lines in HLO that nobody reads here
# What one worker has compiled, and the last run, is not compiled again: a second run takes half the
# time, for some 4 % of the first. Most programs are small, so that all are kept. `make clean`
# removes them.
jax.config.update("jax_compilation_cache_dir", str(ROOT / ".pytest_cache" / "programs"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)

# Before the first import of the package: from here on every annotated call is checked.
jaxtyping.jaxtyped = checked
jaxtyping.install_import_hook("thincam_jax", "beartype.beartype")


def pytest_collection_finish():
    """Settings of what tests import: not of the process that only gives them to the workers."""
    # Tracing makes many short-lived objects: by default a tenth of the time is garbage collection.
    # What was imported stays, and need not be looked at again.
    gc.collect()
    gc.freeze()
    gc.enable()
    gc.set_threshold(50_000, 20, 20)


@pytest.fixture
def key() -> jax.Array:
    """A PRNG key, the same in every run; split it for more."""
    return jax.random.key(20260)


@pytest.fixture
def optimised():
    """For tests that compute for minutes: programs are compiled as in use."""
    before = jax.config.values["jax_disable_most_optimizations"]
    jax.clear_caches()
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.clear_caches()
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture(autouse=True, scope="module")
def few_programs():
    """Drops the compiled programs of the modules before, once there are many.

    They and what was traced take a worker to 5 GB, in place of 2; what is needed again is read from
    the disk in no more time. Each is mapped into memory several times, and Linux allows a process
    65530 mappings, beyond which the compiler crashes.
    """
    yield
    mappings = Path("/proc/self/maps")
    if mappings.exists() and mappings.read_bytes().count(b"\n") > 4_000:
        jax.clear_caches()
        gc.collect()
