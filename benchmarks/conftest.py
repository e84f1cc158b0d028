"""Benchmarks run in single precision against double-precision references."""

import jax

jax.config.update("jax_enable_x64", True)
