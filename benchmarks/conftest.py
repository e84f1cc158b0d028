"""Benchmarks run in single precision against double-precision references."""

from collections import defaultdict
from typing import Any

import jax
import pytest

jax.config.update("jax_enable_x64", True)


@pytest.hookimpl(optionalhook=True)  # without pytest-benchmark the others still run
def pytest_benchmark_update_json(config, benchmarks, output_json: dict[str, Any]) -> None:
    """Add each median over the fastest of its group; leave single timings and the host out."""
    medians = defaultdict(list)
    for one in output_json["benchmarks"]:
        one["stats"].pop("data", None)
        medians[one["group"]].append(one["stats"]["median"])
    for one in output_json["benchmarks"]:
        if one["group"] is not None:
            one["ratio"] = round(one["stats"]["median"] / min(medians[one["group"]]), 3)
    hidden = (("machine_info", ("node", "release")), ("commit_info", ("project", "branch")))
    for part, names in hidden:
        for name in names:
            output_json[part].pop(name, None)
