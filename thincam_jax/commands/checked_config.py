"""Checked sections of an experiment file's text, with a line for every fault, and back."""

import re
from pathlib import Path
from typing import Any, TypeVar, get_args

import pydantic
import yaml

from thincam_jax._core.text import meant, shortened, spelled
from thincam_jax.commands.config_file import ConfigError, Places, override, read_raw
from thincam_jax.commands.sections import ExperimentConfig

Config = TypeVar("Config", bound=pydantic.BaseModel)
Experiment = TypeVar("Experiment", bound=ExperimentConfig)


def load_as(
    model: type[Experiment], path: str | Path, overrides: tuple[str, ...] = ()
) -> Experiment:
    """Read an experiment file of the given sections; `overrides` are "a.b=value" texts.

    Files of the list `model.pictured` and of sections `model.with_path` are named from the folder
    of the experiment file.

    **Errors**: ConfigError with one line for each fault: file and line, field, what was given,
    what is allowed. FileNotFoundError where there is no such file.
    """
    path = Path(path)
    raw, lines = read_raw(path)
    asked = {override(raw, text): f"--set {shortened(text)}" for text in overrides}
    places = Places(raw, lines, asked, f"{path}:1")
    config = check_as(model, places)
    folder = path.resolve().parent
    lists = filter(None, (model.pictured,))
    named = {name: tuple(_placed(e, folder) for e in getattr(config, name)) for name in lists}
    named |= {name: _placed(getattr(config, name), folder) for name in model.with_path}
    config = config.model_copy(update=named)
    config._places = places
    return config


def _placed(entry: Any, folder: Path) -> Any:
    """An entry with the whole path of its file, if it has any."""
    if entry is None or not entry.path:
        return entry
    return entry.model_copy(update={"path": str(folder / entry.path)})


def check_as(model: type[Config], places: Places) -> Config:
    """Check raw data; a fault names the option that set the entry, else the place in the file."""
    try:
        return model.model_validate(places.raw)
    except pydantic.ValidationError as error:
        faults = [_fault(one, places, model) for one in _own(error.errors())]
        raise ConfigError("\n".join(_once(faults, places))) from None


def dump_config(config: pydantic.BaseModel) -> str:
    """The resolved configuration as YAML that is read back to the same values."""
    data = config.model_dump(mode="json", exclude_none=True, by_alias=True)
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=100)


def _own(errors: list[Any]) -> list[Any]:
    """Errors but for lists that pydantic calls too short because it dropped a faulty entry.

    A file of another kind has only that error: its other keys are right for what it is.
    """
    other = [error for error in errors if error["loc"] == ("kind",)]
    return other or [
        error
        for error in errors
        if error["type"] != "too_short"
        or not any(e["loc"][:-1][: len(error["loc"])] == error["loc"] for e in errors)
    ]


def _once(faults: list[tuple[str, str, str]], places: Places) -> list[str]:
    """A line for each fault; what one option does to several entries is reported of the first."""
    lines: dict[tuple[str, ...], list[str]] = {}
    for place, field, message in faults:
        one = (place, message) if place in places.asked.values() else (place, message, field)
        lines.setdefault(one, []).append(field)
    return [
        f"{place}: {fields[0]}{f' and {len(fields) - 1} more' if fields[1:] else ''}: {message}"
        for (place, message, *_), fields in lines.items()
    ]


def _fault(error: Any, places: Places, model: Any) -> tuple[str, str, str]:
    """Place, field, and what is wrong and what is allowed."""
    location = (*error["loc"], *getattr(error.get("ctx", {}).get("error"), "place", ()))
    if error["type"] == "invalid_key":
        location = (*location[:-1], str(location[-1]))
    field = _dotted(location) or "the file"
    none = "; for none write null" if repr(error.get("input")).lower() == "'none'" else ""
    return places.of(location), field, _message(error, location, model) + none


def _message(error: Any, location: tuple, model: Any) -> str:
    """Fault and allowed values, in the words of an experiment file."""
    kind, given, context = error["type"], error.get("input"), error.get("ctx", {})
    if kind == "extra_forbidden":
        allowed = _allowed(location[:-1], model)
        return f"unknown key; allowed here: {', '.join(allowed)}{meant(location[-1], allowed)}"
    if kind == "missing" and isinstance(location[-1], int):
        return "missing; the list needs this entry"
    if kind == "literal_error":
        able = re.findall(r"'([^']*)'", context["expected"])
        return (
            f"{_short(given)} is unknown; choose one of {context['expected']}{meant(given, able)}"
        )
    if kind in ("too_short", "too_long"):
        limit = context.get("min_length", context.get("max_length"))
        word = "at least" if kind == "too_short" else "at most"
        return f"{_short(given)} has {len(given)} entries; give {word} {limit}"
    if kind in _WORDS:
        return _WORDS[kind].format(given=_short(given))
    message = error["msg"].removeprefix("Value error, ")
    if kind == "value_error":
        return message.replace(repr(given), _short(given))
    return f"{_short(given)}: {message[0].lower()}{message[1:]}"


def _short(given: Any) -> str:
    return shortened(repr(given) if isinstance(given, str) else spelled(given))


_WORDS = {
    "missing": "missing; this key is needed",
    "model_type": "{given} is not a section; give lines of 'key: value'",
    "tuple_type": "{given} is not a list; write it as [a, b] or as lines beginning with '- '",
    "invalid_key": "a key must be a text; put it in quotes",
}


def _dotted(location: tuple) -> str:
    text = ""
    for part in location:
        name = shortened(str(part))
        text += f"[{part}]" if isinstance(part, int) else f".{name}" if text else name
    return text


def _allowed(location: tuple, model: Any) -> list[str]:
    """Keys of the section at a location."""
    section: Any = model
    for part in location:
        if isinstance(part, int):
            continue
        section = _section_of(_keys(section)[part].annotation)
    return list(_keys(section))


def _keys(section: Any) -> dict[str, Any]:
    """The fields of a section by what they are called in a file."""
    return {field.alias or name: field for name, field in section.model_fields.items()}


def _section_of(annotation: Any) -> Any:
    if isinstance(annotation, type) and issubclass(annotation, pydantic.BaseModel):
        return annotation
    for inner in get_args(annotation):
        found = _section_of(inner)
        if found is not None:
            return found
    return None
