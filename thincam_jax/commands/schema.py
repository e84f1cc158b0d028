"""Sections of experiment files, read from the constructors of the objects that they describe.

    class SensorConfig(section(Sensor)): ...

has the parameters of `Sensor` as keys, with its defaults. A key is read with the unit of its
`quantity` and checked by the same converter as the object's field; what the object itself refuses
is a fault of the section, a `FieldError` one of the key that it names.
"""

import dataclasses
import inspect
import re
import types
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal, Union, cast, get_args, get_origin

import pydantic
from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    WithJsonSchema,
)
from pydantic_core import PydanticCustomError

from thincam_jax._core.quantity import FieldError, Quantity, quantities
from thincam_jax.units import KINDS, parse_quantity

_WITH_UNIT = r"^\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*[^\d\s.eE].*$"
_NEEDED = inspect.Parameter.empty


def misfit(message: str, *place: str | int) -> PydanticCustomError:
    """A fault between entries, reported at one of them."""
    return PydanticCustomError("misfit", "{message}", {"message": message, "place": place})


class Section(pydantic.BaseModel):
    """A part of an experiment file: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: Any) -> dict[str, Any]:
        """For editors: each key with what the docstring says of it."""
        form = handler.resolve_ref_schema(handler(core_schema))
        about = descriptions(cls)
        for key, entry in form.get("properties", {}).items():
            entry.pop("title", None)
            if key in about:
                entry["description"] = about[key]
        form["description"] = (cls.__doc__ or "").partition("\n")[0]
        return form


class ObjectSection(Section):
    """A section with the parameters of a constructor."""

    maker: ClassVar[Callable[..., Any] | None] = None
    parameters: ClassVar[tuple[str, ...]] = ()
    complete: ClassVar[bool] = False  # it has all that the constructor needs

    def build(self, **others: Any) -> Any:
        """The object; `others` are parameters that the file does not have, or in place of its.

        What the file leaves out, the constructor has a default for.
        """
        maker = type(self).maker
        assert maker is not None  # of several constructors: the subclass chooses
        given = {name: getattr(self, name) for name in self.parameters}
        return maker(**{name: value for name, value in given.items() if value is not None} | others)

    @pydantic.model_validator(mode="after")
    def _made(self):
        if self.complete:
            try:
                self.build()
            except FieldError as error:
                raise misfit(str(error), error.field) from None
            except TypeError as error:
                raise ValueError(str(error)) from None
        return self


def section(
    *makers: Callable[..., Any],
    only: tuple[str, ...] = (),
    without: tuple[str, ...] = (),
    defaults: Mapping[Any, Any] | None = None,
) -> Any:
    """A class whose keys are the parameters of constructors.

    - `only`, `without`: which parameters the file has, or has not.
    - `defaults`: where a file has others than the constructor. None: the key may be left out.
    """
    fields: dict[str, Any] = {}
    complete = len(makers) == 1
    for maker in makers:
        about = descriptions(maker)
        for key, (kind, default) in _parameters(maker).items():
            if key in without or (only and key not in only):
                complete &= default is not _NEEDED
                continue
            default = (defaults or {}).get(key, default)
            complete &= not (default is None and _parameters(maker)[key][1] is _NEEDED)
            kind = kind | None if default is None else kind
            default = ... if default is _NEEDED else default
            fields[key] = kind, Field(default, description=about.get(key))
    name = getattr(makers[0], "__name__", "section")
    made = pydantic.create_model(name, __base__=ObjectSection, **fields)
    made.maker = makers[0] if len(makers) == 1 else None
    made.parameters, made.complete = tuple(fields), complete
    return made


def _parameters(maker: Callable[..., Any]) -> dict[str, tuple[Any, Any]]:
    """Type and default of each parameter, as a file has them."""
    known, converters = quantities(maker), _converters(maker)
    return {
        name: (_type(known.get(name), converters.get(name), annotation), parameter.default)
        for name, parameter, annotation in _annotated(maker)
    }


def _annotated(maker: Any) -> Iterator[tuple[str, inspect.Parameter, Any]]:
    """The parameters, with the annotations of the fields where there are any."""
    types_of = {}
    if dataclasses.is_dataclass(maker):
        types_of = {f.name: f.type for f in dataclasses.fields(maker)}
    for name, parameter in inspect.signature(cast(Callable[..., Any], maker)).parameters.items():
        yield name, parameter, types_of.get(name, parameter.annotation)


def _converters(maker: Callable[..., Any]) -> dict[str, Callable[[Any], Any]]:
    if not dataclasses.is_dataclass(maker):
        return {}
    given = {f.name: f.metadata.get("converter") for f in dataclasses.fields(maker)}
    return {name: one for name, one in given.items() if one is not None}


def _type(known: Quantity | None, converter: Callable[[Any], Any] | None, annotation: Any) -> Any:
    """What pydantic reads: a number with its unit, a choice, or the plain type of an annotation."""
    if known is not None and known.choices:
        return Literal[known.choices]
    plain = _plain(annotation)
    if known is not None and known.kind:
        number = Annotated[float, *written(known)]
        plain = number if plain is float else tuple[(number,) * len(get_args(plain))]
    check = known or converter
    return Annotated[plain, AfterValidator(_checked(check))] if check else plain


def _plain(annotation: Any) -> Any:
    """int, bool, str, a choice or a list of these; arrays and what may be one are numbers."""
    origin = get_origin(annotation)
    if origin is Annotated:
        return _plain(get_args(annotation)[0])
    if origin in (Union, types.UnionType):
        kinds = {_plain(one) for one in get_args(annotation) if one is not types.NoneType}
        return float if float in kinds or len(kinds) > 1 else kinds.pop()
    if annotation in (int, bool, str) or origin in (Literal, tuple):
        return annotation
    return float


def _checked(check: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """The value as it is in the file, where the object's field takes it."""

    def as_it_is(value: Any) -> Any:
        try:
            check(value)
        except TypeError as error:
            raise ValueError(str(error)) from None
        return value

    return as_it_is


def form_of(kind: str) -> dict[str, Any]:
    """The JSON Schema of a number with a unit; `kind` as of `units.parse_quantity`."""
    about = KINDS[kind]
    examples = re.findall(r'"(.*?)"', about.examples)
    form = {"type": "string", "pattern": _WITH_UNIT, "examples": examples}
    return form | {"description": f"{about.name}: {about.advice}"}


def written(given: Quantity) -> tuple[Any, ...]:
    """How a number with a unit is read and written in a file."""

    def read(text: object) -> float:
        value = parse_quantity(text, given.kind)
        if given.positive and not value > 0:
            raise ValueError(f'"{text}" is not positive; give a value above zero')
        return value

    # A resolved file is read back, so it is written in the unit of the package, with every digit.
    write = PlainSerializer(lambda value: f"{value!r} {given.unit}")
    return BeforeValidator(read), write, WithJsonSchema(form_of(given.kind))


def descriptions(maker: Callable[..., Any]) -> dict[str, str]:
    """What the docstring says of each parameter, "- `name`: text"."""
    found: dict[str, str] = {}
    for names, text in re.findall(
        r"^- ((?:`\w+`(?:, )?)+): (.*(?:\n  \S.*)*)", inspect.getdoc(maker) or "", re.MULTILINE
    ):
        found |= dict.fromkeys(re.findall(r"`(\w+)`", names), " ".join(text.split()))
    return found
