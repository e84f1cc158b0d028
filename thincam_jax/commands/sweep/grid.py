"""The axes of a sweep: which entries of a configuration take which values."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from thincam_jax.commands.config_file import ConfigError, path_keys, read_value

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
