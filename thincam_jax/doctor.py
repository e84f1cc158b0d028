"""What a run or a bug report needs to know of the installation."""

import platform
import sys
from importlib import metadata
from typing import Any

import jax
import jax.numpy as jnp

PACKAGES = (
    *("thincam_jax", "jax", "jaxlib", "equinox", "numpy", "scipy", "scikit-image", "optimistix"),
    *("lineax", "optax", "jaxopt", "pydantic", "matplotlib"),
)
OPTIONAL = {
    "pytest-benchmark": "benchmarks (make bench)",
    "mpmath": "tests",
    "hypothesis": "tests",
    "dask": "sweeps (thincam sweep)",
    "distributed": "sweeps (thincam sweep)",
    "pyarrow": "sweeps (thincam sweep)",
}


def environment(seconds: float | None = None) -> dict[str, Any]:
    """Versions and machine of a run."""
    versions = {}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = None
    return {
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "devices": [str(d) for d in jax.devices()],
        "precision": str(jnp.zeros(()).dtype),
        "versions": versions,
        "command": ["thincam", *sys.argv[1:]],
        "seconds": None if seconds is None else round(seconds, 1),
    }


def dtype_support() -> dict[str, str]:
    """Which precisions the default device computes in, tried out."""
    support = {}
    for name in ("float32", "complex64", "float64", "complex128"):
        if name in ("float64", "complex128") and not jax.config.read("jax_enable_x64"):
            support[name] = "off; set JAX_ENABLE_X64=1"
            continue
        try:
            transformed = jnp.fft.fft(jnp.ones(4, dtype=name))
            support[name] = "yes" if bool(jnp.isfinite(transformed).all()) else "wrong results"
        except (TypeError, RuntimeError) as error:
            support[name] = f"no ({type(error).__name__})"
    return support


def missing_parts() -> dict[str, str]:
    """Optional packages that are not installed, and what they are for."""
    missing = {}
    for name, purpose in OPTIONAL.items():
        try:
            metadata.version(name)
        except metadata.PackageNotFoundError:
            missing[name] = purpose
    return missing
