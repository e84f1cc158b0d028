"""The points of a sweep: their configurations and keys, and how a worker measures one."""

import copy
import itertools
import json
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from thincam_jax._core.precision import double_precision
from thincam_jax.commands.checked_config import check_as
from thincam_jax.commands.config_file import ConfigError, Places, set_entry
from thincam_jax.commands.run_folder import digest, origin_of
from thincam_jax.commands.sections import StudyConfig, exposures_of
from thincam_jax.commands.study.build import build_study
from thincam_jax.commands.sweep.grid import Axis
from thincam_jax.studies.result import metrics_row
from thincam_jax.studies.study import unresolved_zones

# Part of every point's key: to be raised when the same configuration is to give other metrics.
METRICS_VERSION = 1
# What a user can put right: the message says all.
_USER_ERRORS = (ConfigError, FileNotFoundError, PermissionError, MemoryError)


@dataclass(frozen=True)
class GridPoint:
    """A configuration of the grid.

    - `key`: name that its results are recognised by, from all that they depend on.
    - `values`: the swept values by the path of their axis; in mm, rad and rad/mm² where they are
      quantities. Those of a refused point are as given.
    - `config`: the resolved configuration as JSON; None if it is refused.
    - `double`: whether it is computed in double precision.
    - `reason`: why the configuration is refused, in one line.
    - `warnings`: warnings about one that is not.
    """

    key: str
    values: dict[str, Any]
    config: str | None
    double: bool
    reason: str | None = None
    warnings: tuple[str, ...] = ()


def make_points(base: StudyConfig, axes: Sequence[Axis], double: bool) -> list[GridPoint]:
    """The points of the grid in order. One that the configuration's checks refuse has a reason.

    **Errors**: ConfigError, one line, where all are refused, as for a path that does not exist, and
    where two are the same.
    """
    raw = base.model_dump(mode="json", exclude_none=True)
    grid = itertools.product(*(axis.values for axis in axes))  # the last changes fastest
    points = [_make_point(raw, axes, values, double) for values in grid]
    if all(point.config is None for point in points):
        raise ConfigError(f"{points[0].reason} (no point of the grid can be run)")
    first: dict[str, GridPoint] = {}
    for point in points:
        if point.key in first:
            raise ConfigError(
                f"--grid: {described(point.values)} comes twice: two of its values are the same; "
                "give each once"
            )
        first[point.key] = point
    return points


def described(values: dict[str, Any]) -> str:
    """Swept values in a message."""
    return ", ".join(f"{path}={value}" for path, value in values.items())


def doubts(points: Sequence[GridPoint]) -> list[str]:
    """Warnings of the first point that has any, and the number of such points."""
    doubtful = [point for point in points if point.warnings]
    return [
        f"{len(doubtful)} of {len(points)} points; the first ({described(first.values)}): "
        f"{'; '.join(first.warnings)}"
        for first in doubtful[:1]
    ]


def _make_point(raw: dict, axes: Sequence[Axis], values: tuple, double: bool) -> GridPoint:
    changed, asked = copy.deepcopy(raw), {}
    given = {axis.path: value for axis, value in zip(axes, values, strict=True)}
    for axis, value in zip(axes, values, strict=True):
        for place in axis.places:
            set_entry(changed, place, value, f"--grid {axis.text}")
            asked[place] = f"--grid {axis.text}"
    try:
        config = check_as(StudyConfig, Places(changed, asked=asked, top="--grid"))
    except ConfigError as error:
        key = _digest(json.dumps(changed, default=str))
        return GridPoint(key, given, None, double, "; ".join(str(error).splitlines()))
    text = config.model_dump_json(exclude_none=True)
    resolved = {axis.path: _entry(config, axis.places[0]) for axis in axes}
    exposures = [e for method in config.methods for e in exposures_of(config, method)]
    numbers = config.sensor.pitch, config.object.distance, config.mask.height
    warnings = unresolved_zones(exposures, *numbers)
    return GridPoint(_key(config, text, double), resolved, text, double, None, tuple(warnings))


def _entry(config: Any, place: tuple) -> Any:
    """The value of an entry; what is no number, text or truth value, as JSON."""
    for key in place:
        config = config[key] if isinstance(key, int) else getattr(config, key)
    if config is None or isinstance(config, bool | int | float | str):
        return config
    if hasattr(config, "model_dump_json"):
        return config.model_dump_json(exclude_none=True)
    return json.dumps(config, default=lambda entry: entry.model_dump(mode="json"))


def _key(config: StudyConfig, text: str, double: bool) -> str:
    """A picture that is not there is the worker's to report."""
    with double_precision(double):
        return _digest(json.dumps([METRICS_VERSION, text, origin_of(config)]))


def _digest(text: str) -> str:
    return digest(text)[:16]


@dataclass(frozen=True)
class Metrics:
    """The metrics of a point by column; or why there are none, in one line, and the traceback."""

    metrics: dict[str, Any] | None
    reason: str | None = None
    traceback: str | None = None


def measure_point(config: str, double: bool) -> Metrics:
    """The metrics of a resolved study, given as JSON; an error is an outcome too."""
    try:
        with double_precision(double):
            return Metrics(metrics_row(build_study(StudyConfig.model_validate_json(config))))
    except _USER_ERRORS as error:
        return Metrics(None, "; ".join(str(error).splitlines()))
    except Exception as error:  # a sweep goes on without a point that shows a defect
        return Metrics(None, one_line(error), traceback.format_exc())


def one_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return ": ".join([type(error).__name__, *lines[:1]])
