"""The points of a sweep: their configurations and keys, and how a worker measures one."""

import copy
import itertools
import json
import math
import re
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from thincam_jax._core.precision import double_precision
from thincam_jax.commands.checked_config import check_as
from thincam_jax.commands.config_file import ConfigError, Places, path_keys, read_value, set_entry
from thincam_jax.commands.run_folder import digest, origin_of
from thincam_jax.commands.sections import StudyConfig, exposures_of
from thincam_jax.commands.study.build import build_study
from thincam_jax.studies.result import metrics_row
from thincam_jax.studies.study import unresolved_zones

MOST_POINTS = 100_000

_FORM = (
    "write it as path=lo:hi:n, path=lo:hi:n:log or path=v1,v2,…, such as seed=0:4:5 or "
    'methods.0.shots.0.beta="15:30:16 rad/mm^2"'
)
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_RANGE = re.compile(rf"\s*({_NUMBER})\s*:\s*({_NUMBER})\s*:\s*(\d+)\s*(:\s*log\b)?(.*)", re.DOTALL)
_WITH_UNIT = re.compile(rf"{_NUMBER}\s*([^\d\s.].*)")


@dataclass(frozen=True)
class Axis:
    """One --grid.

    - `text`: option that was given, for messages.
    - `path`: key that was given; the name of the table's column.
    - `places`: the entries that it sets, all to the same value: one, or several where it has a `*`.
    - `values`: values that they are set to, in order.
    """

    text: str
    path: str
    places: tuple[tuple[str | int, ...], ...]
    values: tuple[Any, ...]


def read_axes(texts: Sequence[str], raw: dict) -> list[Axis]:
    """The axes of --grid options, for a configuration as data.

    **Errors**: ConfigError, one line, for bad syntax, a list entry that does not exist, entries
    that two axes set, and too many points. Whether a field exists and takes the values, only the
    configuration's own checks tell.
    """
    if not texts:
        raise ConfigError(f"a sweep needs a --grid: {_FORM}")
    axes = [_read_axis(text, raw) for text in texts]
    for index, axis in enumerate(axes):
        for other in axes[:index]:
            _refuse_common(axis, other)
    count = math.prod(len(axis.values) for axis in axes)
    if count > MOST_POINTS:
        raise ConfigError(f"the grid has {count} points; give at most {MOST_POINTS}")
    return axes


def _read_axis(text: str, raw: dict) -> Axis:
    path, equals, values = (part.strip() for part in text.partition("="))
    keys = path_keys(path)
    if not equals or keys is None:
        raise ConfigError(f"--grid {text}: {_FORM}")
    if len(keys) == 1 and keys[0] not in raw and (meant := sorted(_paths_to(keys[0], raw))):
        raise ConfigError(
            f"--grid {text}: {path} is no key of the file; write {' or '.join(meant)}"
        )
    return Axis(text, path, _places(text, keys, raw), _values(text, values))


def _paths_to(key: str | int, raw: Any, before: str = "") -> set[str]:
    """Paths of the entries of that name, with `*` for all entries of a list."""
    if isinstance(raw, list):
        return set().union(*(_paths_to(key, entry, f"{before}*.") for entry in raw))
    if not isinstance(raw, dict):
        return set()
    inner = (_paths_to(key, value, f"{before}{name}.") for name, value in raw.items())
    return set().union({f"{before}{key}"} if key in raw else (), *inner)


def _places(text: str, keys: tuple, raw: dict) -> tuple[tuple[str | int, ...], ...]:
    """Each `*` stands for all entries of its list."""
    if "*" not in keys:
        return (keys,)
    depth = keys.index("*")
    here: Any = raw
    for key in keys[:depth]:
        try:
            here = here[key]
        except (LookupError, TypeError):
            here = None
    if not isinstance(here, list):
        parent = ".".join(str(key) for key in keys[:depth]) or "the file"
        raise ConfigError(f"--grid {text}: {parent} is no list, and * stands for a list's entries")
    expanded = [(*keys[:depth], index, *keys[depth + 1 :]) for index in range(len(here))]
    return tuple(place for one in expanded for place in _places(text, one, raw))


def _values(text: str, values: str) -> tuple[Any, ...]:
    if re.match(r"[\d.+-][^,]*:", values):
        return _range(text, values)
    try:
        listed = read_value(f"[{values}]", f"--grid {text}")
    except ConfigError as error:
        raise ConfigError(f"{error}; {_FORM}") from None
    if not listed:
        raise ConfigError(f"--grid {text}: has no values; {_FORM}")
    return tuple(_with_last_unit(listed))


def _range(text: str, values: str) -> tuple[Any, ...]:
    found = _RANGE.fullmatch(values)
    if found is None:
        raise ConfigError(f"--grid {text}: {_FORM}; a unit stands once, at the end")
    low, high, count, log, unit = found.groups()
    low, high, count, unit = float(low), float(high), int(count), unit.strip()
    if re.match(r"[\d.:,+-]", unit):
        raise ConfigError(f"--grid {text}: {_FORM}")
    if not 1 <= count <= MOST_POINTS:
        raise ConfigError(f"--grid {text}: n is {count}; give from 1 to {MOST_POINTS} values")
    if log and not (low > 0 and high > 0):
        raise ConfigError(f"--grid {text}: log needs both ends above zero")
    numbers = (np.geomspace if log else np.linspace)(low, high, count)
    return tuple(f"{_number(n)} {unit}" if unit else _number(n) for n in numbers)


def _number(value: float) -> int | float:
    """Number without the steps' rounding, 0.3 for 0.30000000000000004; whole ones as int."""
    value = float(f"{value:.12g}")
    return int(value) if value.is_integer() else value


def _with_last_unit(values: list) -> list:
    """`5, 6, 8 mm` are millimetres all."""
    last = _WITH_UNIT.fullmatch(values[-1].strip()) if isinstance(values[-1], str) else None
    bare = [isinstance(v, int | float) and not isinstance(v, bool) for v in values[:-1]]
    if last is None or not bare or not all(bare):
        return values
    return [*(f"{value} {last.group(1)}" for value in values[:-1]), values[-1]]


def _refuse_common(axis: Axis, other: Axis) -> None:
    """Refuse two axes of which one sets what the other sets, or a part of it."""
    for place in axis.places:
        for set_before in other.places:
            shorter = min(len(place), len(set_before))
            if place[:shorter] == set_before[:shorter]:
                entry = ".".join(str(key) for key in place)
                raise ConfigError(
                    f"--grid {axis.text}: {entry} is set by --grid {other.text} too; give it once"
                )


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
