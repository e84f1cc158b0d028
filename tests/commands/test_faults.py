"""Faults of every key of every kind of file, generated from the sections themselves.

What a key may hold stands in its section's JSON Schema. A value of another type, without a unit or
out of range is refused in one line with file, line, key, what was given and what is allowed, and
the schema that editors check with refuses it, too.
"""

import ast
import functools
import inspect
import textwrap
from typing import Any, Literal, get_args, get_origin

import pytest
from jsonschema import Draft202012Validator

from thincam_jax._core.quantity import quantities
from thincam_jax.commands.checked_config import check_as
from thincam_jax.commands.config_file import ConfigError, Places
from thincam_jax.commands.kinds import KINDS
from thincam_jax.commands.schema import Section
from thincam_jax.hardware.base import Region
from thincam_jax.lensless.exposures import Layout
from thincam_jax.waveguide import Rectangle

WRONG_UNIT = "5.5 kg"

CONSTRUCTING = ("__init__", "__post_init__", "__check_init__", "record")


def inside(annotation):
    """The sections of an annotation."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        yield annotation
    for part in get_args(annotation):
        yield from inside(part)


def below(section, known):
    """A section with all that are in it."""
    if section not in known:
        known.append(section)
        for field in section.model_fields.values():
            for inner in inside(field.annotation):
                below(inner, known)
    return known


SECTIONS: list[Any] = []
for kind in KINDS.values():
    below(kind.part(kind.section), SECTIONS)
MAKERS = {m: 0 for s in SECTIONS for base in s.__mro__ for m in vars(base).get("makers", {})}


def faults(section, raw, key):
    """The lines that are about a key, of a section of its own kind."""
    place, raw = "a.yaml:7", word_of(section) | raw
    with pytest.raises(ConfigError) as error:
        check_as(section, Places(raw, {(key,): place}, top="a.yaml:1"))
    lines = str(error.value).split("\n")
    return [line.removeprefix(f"{place}: ") for line in lines if line.startswith(f"{place}: {key}")]


@functools.cache
def schema_of(section):
    return section.model_json_schema()


@functools.cache
def word_of(section):
    """Words that are needed, and that other keys depend on."""
    schema = schema_of(section)
    needed = {key: schema["properties"][key] for key in schema.get("required", ())}
    return {
        key: form.get("const", form.get("enum", [None])[0])
        for key, form in needed.items()
        if "const" in form or "enum" in form
    }


def wrong(form):
    """Values that a key does not take, each with what the message must say."""
    if "enum" in form or "const" in form:
        yield "nonsense", ["'nonsense' is unknown; choose one of", *form.get("enum", [])[:1]]
    elif form.get("type") == "string" and "pattern" in form and "examples" in form:
        unit = form["examples"][0].partition(" ")[2]
        yield 5.5, ["5.5 has no unit: write a", "such as"]
        yield "5.5 kg", [f'"{WRONG_UNIT}" is a mass, not a']
        yield f"nan {unit}", ["not finite"]
        if "[+-]" not in form["pattern"]:
            yield f"-1 {unit}", ["is not positive; give a value above zero"]
            yield f"0 {unit}", ["is not positive; give a value above zero"]
    elif form.get("type") == "string":
        yield 5, ["5: input should be a valid string"]
    elif form.get("type") == "boolean":
        yield "perhaps", ["'perhaps': input should be a valid boolean"]
    elif form.get("type") in ("integer", "number"):
        yield "loud", ["'loud': input should be a valid"]
        for end, step in (("minimum", -1), ("exclusiveMinimum", 0), ("maximum", 1)):
            if end in form:
                yield form[end] + step, [f"{form[end] + step}", "give|should be"]
    elif form.get("type") == "array":
        yield 5, ["5 is no"]
    elif form.get("type") == "object":
        yield 5, ["5"]


def forms(form, defs):
    """What a key may be, without None."""
    form = defs[form["$ref"].rpartition("/")[2]] if "$ref" in form else form
    for one in form.get("anyOf", [form]):
        if one is not form:
            yield from forms(one, defs)
        elif one.get("type") != "null":
            yield one


@pytest.mark.parametrize("section", SECTIONS, ids=lambda section: section.__name__)
def test_every_key_refuses_what_it_does_not_take(section):
    schema = schema_of(section)
    defs, tried = schema.get("$defs", {}), set()
    for key, form in schema.get("properties", {}).items():
        allowed, *paths = forms(form, defs)  # some sections may be the path of a file
        assert not paths or [allowed["type"], paths[0]["type"]] == ["object", "string"]
        for value, parts in wrong(allowed):
            found = faults(section, {key: value}, key)
            assert found, f"{key}: {value!r} is taken"
            for part in parts:
                assert any(one in found[0] for one in part.split("|")), (found, part)
            one = {"$defs": defs, "properties": {key: form}}
            if not str(value).startswith((WRONG_UNIT, "0 ")):  # of which a pattern knows nothing
                assert not Draft202012Validator(one).is_valid({key: value}), f"{key}: {value!r}"
            tried.add(key)
    free = {"options"}
    assert set(schema.get("properties", {})) - tried <= free
    for key in schema.get("required", ()):
        given = {other: word for other, word in word_of(section).items() if other != key}
        with pytest.raises(ConfigError, match=f"a.yaml:1: {key}: missing; this key is needed"):
            check_as(section, Places(given, top="a.yaml:1"))
    told = faults(section, {"qqqq": 1}, "qqqq")
    keys = [field.alias or name for name, field in section.model_fields.items()]
    assert told == [f"qqqq: unknown key; allowed here: {', '.join(keys)}"]


@pytest.mark.parametrize("maker", MAKERS, ids=lambda maker: maker.__name__)
def test_constructors_of_sections_state_ranges_and_blame_a_field(maker):
    """Numbers of files have a quantity; a fault between fields is a `FieldError`."""
    made = [vars(base).get("makers", {}).get(maker, ()) for s in SECTIONS for base in s.__mro__]
    parameters, known = inspect.signature(maker).parameters, quantities(maker)
    for key in {key for keys in made for key in keys} - set(known):
        stated = parameters[key].annotation  # a type that says which values there are, or a name
        records = Region | None, Rectangle | None, Layout | None  # which have sections of their own
        assert stated in (bool, str, *records) or get_origin(stated) is Literal, key
    tree = ast.parse(textwrap.dedent(inspect.getsource(maker)))
    for body in ast.walk(tree):
        if isinstance(body, ast.FunctionDef) and body.name in CONSTRUCTING:
            raised = [n.exc for n in ast.walk(body) if isinstance(n, ast.Raise)]
            names = [getattr(getattr(one, "func", None), "id", "") for one in raised]
            assert "ValueError" not in names, body.name
