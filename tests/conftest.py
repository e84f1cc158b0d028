"""What every test runs with: float64, strict dtype promotion, checked types, no display."""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # set it to run the tests on another device
os.environ["MPLBACKEND"] = "Agg"

import jax
import jaxtyping
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Before the first import of the package: from here on every annotated call is checked.
jaxtyping.install_import_hook("thincam_jax", "beartype.beartype")


@pytest.fixture
def key() -> jax.Array:
    """A PRNG key, the same in every run; split it for more."""
    return jax.random.key(20260)
