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
from collections.abc import Callable, Mapping
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

from thincam_jax._core import checks
from thincam_jax._core.quantity import Quantity, quantities, quantity
from thincam_jax.units import KINDS, nm, parse_quantity

_WITH_UNIT = r"^\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*[^\d\s.eE].*$"
_NEEDED = inspect.Parameter.empty


class Section(pydantic.BaseModel):
    """A part of an experiment file: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: Any) -> dict[str, Any]:
        """JSON schema for editors: each key with what the docstring says of it."""
        form = handler.resolve_ref_schema(handler(core_schema))
        about = descriptions(cls)
        for key, entry in form.get("properties", {}).items():
            entry.pop("title", None)
            if key in about:
                entry["description"] = about[key]
        form["description"] = (cls.__doc__ or "").partition("\n")[0]
        return form


class ObjectSection(Section):
    """A section with the parameters of constructors.

    - `parameters`: all of its keys; `makers`: the constructors, each with its own.
    - `complete`: constructors that need no more than the section has.
    """

    parameters: ClassVar[tuple[str, ...]] = ()
    makers: ClassVar[dict[Any, tuple[str, ...]]] = {}
    complete: ClassVar[tuple[Callable[..., Any], ...]] = ()

    def build(self, maker: Callable[..., Any] | None = None, **others: Any) -> Any:
        """The object; `others` are parameters that the file does not have, or in place of its.

        What the file leaves out, the constructor has a default for. `maker`: one of several.
        """
        maker = maker or next(iter(self.makers))
        given = {}
        for name in self.makers[maker]:
            if (value := getattr(self, name)) is not None:
                given[name] = value.build() if isinstance(value, ObjectSection) else value
        return cast(Any, maker)(**given | others)

    @pydantic.model_validator(mode="after")
    def _made(self):
        for maker in self.complete:
            try:
                self.build(maker)
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

    - `only`, `without`: parameters that the file has, or has not.
    - `defaults`: defaults of the file that differ from the constructor's. None: the key may be left
      out.
    """
    fields: dict[str, Any] = {}
    keys: dict[Any, tuple[str, ...]] = {}
    needing: set[Any] = set()  # constructors that need more than the section has
    for maker in makers:
        about, parameters = descriptions(maker), _parameters(maker)
        keys[maker] = tuple(k for k in parameters if k not in without and (not only or k in only))
        for key, (kind, given) in parameters.items():
            default = (defaults or {}).get(key, given)
            # Of several constructors, what has no number may be meant for another one.
            unset = default is None is not given and (len(makers) > 1 or given is _NEEDED)
            if unset if key in keys[maker] else given is _NEEDED:
                needing.add(maker)
            if key in keys[maker]:
                kind = kind | None if default is None else kind
                default = ... if default is _NEEDED else default
                fields[key] = kind, Field(default, description=about.get(key))
    name = getattr(next(iter(keys)), "__name__", "section")
    made = pydantic.create_model(name, __base__=ObjectSection, **fields)
    made.parameters, made.makers = tuple(fields), keys
    made.complete = tuple(maker for maker in makers if maker not in needing)
    return made


def _parameters(maker: Callable[..., Any]) -> dict[str, tuple[Any, Any]]:
    """Type and default of each parameter, as a file has them."""
    known, found, fields = quantities(maker), {}, {}
    if dataclasses.is_dataclass(maker):
        fields = {field.name: field for field in dataclasses.fields(maker)}
    for name, parameter in inspect.signature(cast(Any, maker)).parameters.items():
        annotation, converter = parameter.annotation, None
        if name in fields:
            annotation, converter = fields[name].type, fields[name].metadata.get("converter")
        found[name] = _type(known.get(name), converter, annotation), parameter.default
    return found


def _type(known: Quantity | None, converter: Callable[[Any], Any] | None, annotation: Any) -> Any:
    """Type for pydantic: a number with its unit, a choice, or the plain type of an annotation."""
    plain = _plain(annotation)
    if known is None:
        return Annotated[plain, AfterValidator(_checked(converter))] if converter else plain
    if known.choices:
        word = Literal[known.choices]
        return tuple[word, ...] if known.many else word
    least = "exclusiveMinimum" if known.positive else "minimum"
    ends = {least: known.least, "maximum": known.most}
    form = Field(json_schema_extra={name: end for name, end in ends.items() if end is not None})
    about = written(known) if known.kind else (form,)
    if get_origin(plain) is tuple:
        parts = (Annotated[p, *about] if p in (int, float) else p for p in get_args(plain))
        plain = tuple[tuple(parts)]
    else:
        plain = Annotated[plain, *about]
    return Annotated[plain, AfterValidator(_checked(known))]


def _plain(annotation: Any) -> Any:
    """int, bool, str, a choice, a list of these, or a section of a plain record.

    Arrays and what may be one are numbers.
    """
    origin = get_origin(annotation)
    if origin is Annotated:
        return _plain(get_args(annotation)[0])
    if origin in (Union, types.UnionType):
        kinds = [one for one in get_args(annotation) if one is not types.NoneType]
        return float if len(kinds) > 1 else _plain(kinds[0])
    if annotation in (int, bool, str) or origin in (Literal, tuple):
        return annotation
    if dataclasses.is_dataclass(annotation) and type(annotation) is type:  # no module of JAX
        return section(cast(Any, annotation))
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


def form_of(kind: str, positive: bool = False) -> dict[str, Any]:
    """The JSON Schema of a number; `kind` as of `units.parse_quantity`, empty without a unit."""
    if not kind:
        return {"type": "number"}
    about = KINDS[kind]
    examples = re.findall(r'"(.*?)"', about.examples)
    pattern = _WITH_UNIT.replace("[+-]", "[+]", 1) if positive else _WITH_UNIT
    form = {"type": "string", "pattern": pattern, "examples": examples}
    return form | {"description": f"{about.name}: {about.advice}"}


def written(given: Quantity) -> tuple[Any, ...]:
    """Reader and printer of a number with a unit in a file."""

    def read(text: object) -> float:
        value = parse_quantity(text, given.kind)
        if given.positive and not value > 0:
            raise ValueError(f'"{text}" is not positive; give a value above zero')
        return value

    # A resolved file is read back, so it is written in the unit of the package, with every digit.
    write = PlainSerializer(lambda value: f"{value!r} {given.unit}")
    return BeforeValidator(read), write, WithJsonSchema(form_of(given.kind, given.positive))


def descriptions(maker: Callable[..., Any]) -> dict[str, str]:
    """Text of the docstring on each parameter, "- `name`: text"."""
    found: dict[str, str] = {}
    for names, text in re.findall(
        r"^- ((?:`\w+`(?:, )?)+): (.*(?:\n  \S.*)*)", inspect.getdoc(maker) or "", re.MULTILINE
    ):
        found |= dict.fromkeys(re.findall(r"`(\w+)`", names), " ".join(text.split()))
    return found


LIGHT = (10 * nm, checks.LONGEST_LIGHT)  # the wavelengths that are taken for light, mm


def _optical(value: float) -> float:
    if not LIGHT[0] <= value <= LIGHT[1]:
        raise ValueError(f"{value:g} mm is no wavelength of light; give 10 nm to 0.1 mm")
    return value


Length = Annotated[float, *written(quantity("mm", positive=True))]
Position = Annotated[float, *written(quantity("mm"))]
Wavelength = Annotated[
    float, *written(quantity("mm", check=checks.wavelength)), AfterValidator(_optical)
]
Curvature = Annotated[float, *written(quantity("rad/mm^2", positive=True))]
Angle = Annotated[float, *written(quantity("rad"))]
Time = Annotated[float, *written(quantity("s", positive=True))]
