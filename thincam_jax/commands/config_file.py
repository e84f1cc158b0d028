"""The text of an experiment file: YAML read with the lines of its entries, values set by path."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from thincam_jax._core.files import TooLargeError, read_regular
from thincam_jax._core.text import shortened

_MOST_ENTRIES = 100_000
_LONGEST_NUMBER = 200  # characters; of larger numbers, Python makes none, or no text
_MOST_BYTES = 2**17  # which the parser takes a second for


class ConfigError(ValueError):
    """An experiment file that cannot be used; the message has a line for every fault."""


@dataclass(frozen=True)
class Places:
    """Origin of the entries of raw data; it makes no difference to their values.

    - `lines`: file and line, by location; `asked`: the options that set an entry, by location.
    - `top`: the place of what has none.
    """

    raw: Any = field(default=None, compare=False)
    lines: dict[tuple, str] = field(default_factory=dict, compare=False)
    asked: dict[tuple, str] = field(default_factory=dict, compare=False)
    top: str = field(default="", compare=False)

    def of(self, location: tuple) -> str:
        """The option or the file's line that holds a location, or what is nearest to it."""
        parts = [location[:end] for end in range(len(location), 0, -1)]
        for part in parts:  # an option stands in for whatever the file has there
            if part in self.asked:
                return self.asked[part]
        for path, option in self.asked.items():
            inside = location and path[: len(location)] == location
            # An entry that was set is what is wrong with its list.
            if inside and (location not in self.lines or isinstance(path[len(location)], int)):
                return option
        entries = (one for part in parts for one in ((*part, "(key)"), part))
        return next((self.lines[one] for one in entries if one in self.lines), self.top)

    def gives(self, location: tuple) -> bool:
        """Whether the raw data have an entry."""
        raw = self.raw
        for part in location:
            try:
                raw = raw[part]
            except (KeyError, IndexError, TypeError):
                return False
        return True


def read_raw(path: Path) -> tuple[dict, dict[tuple, str]]:
    """The raw data of a YAML file, and the file and line of every entry."""
    if not path.is_file():
        what = "a folder" if path.is_dir() else "missing"
        raise FileNotFoundError(f"{path} is {what}; give the path of a YAML experiment file")
    try:
        node, raw = _read_yaml(read_regular(path, _MOST_BYTES).decode("utf-8"))
        twice: set[tuple[int, str]] = set()  # an aliased part is reported once
        places = {location: f"{path}:{line}" for location, line in _lines(node, twice)}
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a text file in UTF-8 ({error.reason})") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "not YAML"
        raise ConfigError(f"{path}{line}: not valid YAML: {problem}") from None
    except TooLargeError as error:
        raise ConfigError(f"{path}: {error}") from None
    except ValueError as error:  # such as a date that does not exist
        raise ConfigError(f"{path}: not valid YAML: {error}; put texts in quotes") from None
    if not isinstance(raw, dict):
        raise ConfigError(f"{path}:1: give a mapping of 'key: value' lines, beginning with 'name:'")
    if twice:
        raise ConfigError("\n".join(f"{path}:{line}: {fault}" for line, fault in sorted(twice)))
    return raw, places


def _read_yaml(text: str) -> tuple[yaml.Node | None, Any]:
    """The composed nodes of a document and its data.

    Entries are counted before any is built, an aliased part wherever it stands: ten nested aliases
    make billions of 386 bytes.
    """
    try:
        node = yaml.compose(text, Loader=yaml.SafeLoader)
        count = 0 if node is None else _entries(node, {})
        if count > _MOST_ENTRIES:
            raise TooLargeError(
                f"holds {count} entries (an alias counts as all that it stands for), at most "
                f"{_MOST_ENTRIES} are read; give fewer"
            )
        return node, yaml.safe_load(text)
    except RecursionError:
        raise TooLargeError("nested too deeply, or an alias inside its anchor") from None


def _entries(node: yaml.Node, known: dict[int, int]) -> int:
    """Entries of a node with those of all below it; each node is visited once."""
    if node.tag[-4:] in (":int", "loat") and len(node.value) > _LONGEST_NUMBER:
        where, most = f"line {node.start_mark.line + 1}", f"at most {_LONGEST_NUMBER}"
        raise TooLargeError(f"{where} has a number of {len(node.value)} characters; give {most}")
    if id(node) not in known and isinstance(node, yaml.CollectionNode):
        inner = (
            n for entry in node.value for n in (entry if isinstance(entry, tuple) else (entry,))
        )
        known[id(node)] = 1 + sum(_entries(n, known) for n in inner)
    return known.get(id(node), 1)


def _lines(node, twice: set[tuple[int, str]], location: tuple = ()):
    """(location, line) of every entry of a composed YAML document.

    `twice` is given the keys that repeat one of their mapping; PyYAML takes the last of them.
    """
    if node is None:
        return
    yield location, node.start_mark.line + 1
    if isinstance(node, yaml.MappingNode):
        first: dict[str, int] = {}
        for key, value in node.value:
            # Of a section, a reader looks for the line of its key.
            line = key.start_mark.line + 1
            yield (*location, key.value, "(key)"), line
            if key.value in first:
                before = f"first in line {first[key.value]}"
                twice.add((line, f"{key.value}: this key stands twice ({before}); keep one"))
            first.setdefault(key.value, line)
            yield from _lines(value, twice, (*location, key.value))
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            yield from _lines(value, twice, (*location, index))


def override(raw: Any, text: str) -> tuple:
    """Set one value in the raw data, by "a.b=value"; returns the path's keys.

    The path may name what is not there yet.
    """
    path, equals, value = text.partition("=")
    keys, asked = path_keys(path), f"--set {shortened(text)}"
    if not equals or keys is None:
        raise ConfigError(f"{asked}: write it as a.b=value, such as mask.width=5.632mm")
    set_entry(raw, keys, read_value(value, asked), asked)
    return keys


def path_keys(path: str) -> tuple[str | int, ...] | None:
    """The keys of a dotted path, list entries as numbers; None where one is empty."""
    keys = path.strip().split(".")
    return tuple(int(k) if k.isdecimal() else k for k in keys) if all(keys) else None


def set_entry(raw: Any, keys: tuple, value: Any, asked: str) -> None:
    """Set the entry at a path; `asked`: the user's words, for the message."""
    here: Any = raw
    for depth, key in enumerate(keys):
        known = (isinstance(here, list) and isinstance(key, int) and key < len(here)) or isinstance(
            here, dict
        )
        if not known:
            parent = ".".join(str(k) for k in keys[:depth]) or "the file"
            raise ConfigError(f"{asked}: {parent} has no entry {key!r}")
        if depth == len(keys) - 1:
            here[key] = value
        else:
            here = here.setdefault(key, {}) if isinstance(here, dict) else here[key]


def read_value(text: str, asked: str) -> Any:
    """A value as YAML has it; `asked`: the user's words, for the message."""
    try:
        return _read_yaml(text)[1]
    except TooLargeError as error:
        raise ConfigError(f"{asked}: {error}") from None
    except (yaml.YAMLError, ValueError):
        given = shortened(repr(text))
        raise ConfigError(f"{asked}: {given} is not valid YAML; put texts in quotes") from None
