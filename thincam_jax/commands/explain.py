"""The commands `thincam schema` and `thincam explain`: what a file may hold, and what one comes to.

As the files `command.py`, it imports nothing at its head that `thincam --help` does not need.
"""

from collections.abc import Iterator
from typing import Annotated, Any

import typer

from thincam_jax._core.text import spelled
from thincam_jax.commands.kinds import KINDS, kind_of, load_experiment
from thincam_jax.commands.terminal import ConfigFile, Overrides, reported, say, say_result


def schema(
    kind: Annotated[
        str, typer.Argument(help=f"One of {', '.join(KINDS)}.", autocompletion=lambda: list(KINDS))
    ],
) -> None:
    """Print the JSON Schema of a kind of experiment file, with which editors complete and check."""
    with reported(lambda: "interrupted"):
        import json

        from thincam_jax.commands.config_file import ConfigError

        if kind not in KINDS:
            raise ConfigError(f"kind: {kind!r} is unknown; choose one of {', '.join(KINDS)}")
        form = KINDS[kind].part(KINDS[kind].section).model_json_schema()
    say(json.dumps(form, indent=2))


def explain(config: ConfigFile, set_: Overrides = None) -> None:
    """Print every value of an experiment file with its unit and where it comes from.

    Also what a run computes: error, memory and operations of PSFs, rays of a screen, evaluations of
    a search, frames of a capture, steps of a training.
    """
    with reported(lambda: "interrupted"):
        asked = load_experiment(config, tuple(set_ or ()), command=None)
        rows = list(values(asked))
        width = max(len(f"{key}: {value}") for key, value, _ in rows if len(value) <= _LONGEST)
        lines = [f"{f'{key}: {value}':<{width}}  # {place}" for key, value, place in rows]
        costly = list(costs(asked))
        result = {"values": {key: value for key, value, _ in rows}, "costs": costly}
        say_result("experiment", result, "\n".join([*lines, *costly]))


_LONGEST = 50  # characters of a value that places are lined up behind


def values(asked: Any) -> Iterator[tuple[str, str, str]]:
    """Key, value and place of every entry of a checked file; "default" where it has none."""
    data = asked.model_dump(mode="json", exclude_none=True, by_alias=True, exclude={"notes"})
    for location, value in _entries(data):
        key = "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in location)
        place = asked.place_of(*location).removesuffix(": ") if asked.gives(*location) else ""
        yield key.removeprefix("."), value, place or "default"


def _entries(data: Any, location: tuple = ()) -> Iterator[tuple[tuple, str]]:
    """Values by location; a list of values is one."""
    inner = data.items() if isinstance(data, dict) else enumerate(data)
    for key, value in inner:
        inside = value if isinstance(value, list) else ()
        if isinstance(value, dict) or any(isinstance(one, (dict, list)) for one in inside):
            yield from _entries(value, (*location, key))
        else:
            text = (
                f"[{', '.join(map(spelled, value))}]" if isinstance(value, list) else spelled(value)
            )
            yield (*location, key), text


def dry_run(asked: Any, writes: str, setup: Any = None) -> None:
    """Print what a command would compute and write, for its option `--dry-run`.

    The names of each list of the file, and the costs.
    """
    lines = []
    for key, entries in asked:
        if entries and isinstance(entries, tuple) and all(hasattr(e, "name") for e in entries):
            lines.append(f"{len(entries)} {key}: {'; '.join(entry.name for entry in entries)}")
    lines += [*costs(asked, setup), writes, "dry run: nothing was done"]
    say_result("dry_run", lines, "\n".join(lines))


def costs(asked: Any, setup: Any = None) -> Iterator[str]:
    """Work of a file's run, in numbers; `setup`: objects built of it, where they are."""
    kind = kind_of(asked)
    return kind.part(kind.costs)(asked, setup)
