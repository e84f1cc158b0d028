"""The installation: versions, devices, and whether the compiler computes right."""

import contextlib
import datetime
import os
import platform
import subprocess
import sys
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from packaging.requirements import Requirement

from thincam_jax._core.memory import available_bytes, readable
from thincam_jax._core.precision import product

PACKAGES = (
    *("thincam_jax", "jax", "jaxlib", "equinox", "numpy", "scipy", "scikit-image", "optimistix"),
    *("lineax", "optax", "jaxopt", "pydantic", "matplotlib"),
)
# What each extra of pyproject.toml is for.
EXTRAS = {
    "hardware": "the rig",
    "sweep": "sweeps",
    "notebook": "explore",
    "stores": "stores of captures and matrices",
    "codecs": "compressed TIFF and 16-bit colour PNG",
    "raw": "DNG and raw files of cameras",
    "containers": "HDF5 and MATLAB 7.3",
    "datasets": "data sets in Parquet",
    "layout": "masks for lithography (GDS)",
}


def environment(seconds: float | None = None) -> dict[str, Any]:
    """Versions and machine of a run."""
    versions = dict.fromkeys(PACKAGES) | installed(PACKAGES)
    return {
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "devices": [str(d) for d in jax.devices()],
        "cores": usable_cores(),
        "memory": "size not known" if (free := available_bytes()) is None else readable(free),
        "precision": str(jnp.zeros(()).dtype),
        "versions": versions,
        "command": ["thincam", *sys.argv[1:]],
        "date": datetime.datetime.now().astimezone().isoformat(" ", "minutes"),
        "commit": _commit(),
        "seconds": None if seconds is None else round(seconds, 1),
    }


def _commit() -> str | None:
    """Commit of the checkout that the package is run from; None where it was installed."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return None
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        asked = ["git", "-C", str(root), "rev-parse", "--short", "HEAD"]
        return subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()
    return None


def machine_report() -> list[str]:
    """Lines with the machine, its precisions, and whether its compiled sums are right."""
    found = environment()
    return [
        f"Python {found['python']} on {found['platform']}",
        "devices: " + ", ".join(found["devices"]),
        f"cores: {found['cores']}; memory: {found['memory']} free",
        *(f"  {name}: {support}" for name, support in dtype_support().items()),
        f"  compiled sums: {compiled_sums()}",
    ]


def verdict() -> list[str]:
    """Lines that say what can be done here, and what to install for the rest."""
    there = installed(PACKAGES)
    wrong = [f"{name} is not installed" for name in PACKAGES if name not in there]
    if (sums := compiled_sums()) != "right":
        wrong.append(f"compiled sums are {sums}")
    lacking = {extra: missing for extra in EXTRAS if (missing := missing_packages(extra))}
    can = ["simulate", "reconstruct", "design", *(EXTRAS[e] for e in EXTRAS if e not in lacking)]
    return [
        f"not ready: {'; '.join(wrong)}" if wrong else f"ready: {', '.join(can)}",
        *(
            f"not installed: {EXTRAS[extra]} ({', '.join(missing)}); "
            f"pip install 'thincam-jax[{extra}]'"
            for extra, missing in lacking.items()
        ),
    ]


def missing_packages(extra: str) -> list[str]:
    """The packages of an extra that are not installed."""
    found: list[str] = []
    for one in map(Requirement, metadata.requires("thincam_jax") or ()):
        with_it, without = (
            one.marker is None or one.marker.evaluate({"extra": name}) for name in (extra, "")
        )
        if without or not with_it:
            continue
        if one.extras:
            found += [name for other in sorted(one.extras) for name in missing_packages(other)]
        elif not installed([one.name]):
            found.append(one.name)
    return found


def package_report() -> list[str]:
    """Lines with the versions of packages."""
    versions = dict.fromkeys(PACKAGES) | installed(PACKAGES)
    return [f"{name} {version or 'NOT INSTALLED'}" for name, version in versions.items()]


def usable_cores() -> int:
    """Cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        return os.cpu_count() or 1


def dtype_support() -> dict[str, str]:
    """Precisions that the default device computes in, tried out."""
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


def compiled_sums() -> str:
    """Whether the compiler of the default device adds up right, tried out.

    jaxlib 0.10.2 does not on a CPU: reductions that it fuses with what follows read other memory
    (https://github.com/jax-ml/jax/issues/39103), and the result is a number, or none.
    """
    rows = np.random.default_rng(0).uniform(0.5, 1.5, (40_000, 3)).astype(np.float32)
    response, capture = rows.ravel()[: 4 * 64**2].reshape(2, 1, 2, 64, 64)
    noise = np.asarray([[0.7, 1.3]], np.float32)
    squares = jax.jit(_of_rows)(rows, np.eye(3, dtype=np.float32))
    means = jax.jit(_of_channels)(response, capture, noise)
    right = np.allclose(squares, np.sum(rows**2, axis=1), rtol=1e-4) and np.allclose(
        means, _of_channels(response, capture, noise), rtol=1e-4
    )
    return "right" if right else "WRONG; install another jaxlib, such as 0.10.1"


def _of_rows(rows, matrix):
    return jax.vmap(lambda row: jnp.sum(product(matrix, row) ** 2))(rows)


def _of_channels(response, capture, noise):
    """A mean weighted by noise, as of the channels of a Wiener filter."""
    noise = noise[:, :, None, None]
    return (response / noise * capture).sum(1) / ((response**2 / noise).sum(1) + 1)


def installed(packages: Iterable[str]) -> dict[str, str]:
    """The versions of those that are."""
    found = {}
    for name in packages:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found
