"""Unit, range and choices of a number, stated once at its field.

    beta: Float[Array, ""] = eqx.field(converter=quantity("rad/mm^2", positive=True))

The quantity checks what is given; printers, readers of files, options, labels of axes and tables
ask it for the unit. A parameter without an attribute has it in its annotation,
`Annotated[Number, quantity("mm", positive=True)]`.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from thincam_jax._core import checks
from thincam_jax.units import KINDS

# A number in one of the first stands with its unit in a file, in one of the others alone. Further
# texts, such as "parts of one", are words for messages.
_WRITTEN = {kind.unit: name for name, kind in reversed(KINDS.items())}
UNITS = (*_WRITTEN, "rad/mm", "cycles/rad", "electrons", "electrons/mm^2", "dB")
_IN_WORDS = {"electrons/mm^2": "electrons from each mm²"}
# Lengths are printed in the largest of these that they reach: in mm, name, smallest value.
_LENGTHS = ((1.0, "mm", 0.1), (1e-3, "µm", 1e-3), (1e-6, "nm", 0.0))


class FieldError(ValueError):
    """A fault between keys: `field` is the one to change, `place` the way to an entry of it."""

    def __init__(self, message: str, field: str, *entry: str | int):
        super().__init__(message)
        self.field, self.place = field, (field, *entry)


@dataclass(eq=False)
class Quantity:
    """One number or choice, made by `quantity` or `choice`: the converter of an attribute.

    - `unit`: one of `UNITS`, or words for messages.
    - `check`: function of a name and a value: the value to keep, or ValueError or TypeError in one
      line.
    - `positive`, `optional`: above 0; may be None.
    - `choices`: all that are allowed; empty for numbers.
    - `least`, `most`: ends of the range, where it has any.
    - `many`: a tuple of such values, of any length.
    - `parts`: quantities of a dictionary, by its keys.
    - `name`: name of the field, which a `Module` gives it.
    """

    unit: str
    check: Callable[[str, Any], Any] | None
    positive: bool = False
    optional: bool = False
    choices: tuple[str, ...] = ()
    least: float | int | None = None
    most: float | int | None = None
    many: bool = False
    parts: Mapping[str, "Quantity"] = dataclasses.field(default_factory=dict)
    name: str = "value"

    def __call__(self, value: Any) -> Any:
        if self.check is None or (value is None and self.optional):
            return value
        if not self.many:
            return self.check(self.name, value)
        for one in value or ():
            self.check(self.name, one)
        return value

    @property
    def kind(self) -> str:
        """Kind that `units.parse_quantity` reads; empty for what has no unit in a file."""
        light = self.check in (checks.wavelength, checks.wavelengths)
        return "wavelength" if light else _WRITTEN.get(self.unit, "")

    @property
    def symbol(self) -> str:
        """The unit as it is printed, "rad/mm²"; empty for none."""
        return self.unit.replace("^2", "²") if self.unit in UNITS else ""

    def label(self, name: str) -> str:
        """A name with the unit, for tables: "distance, mm"."""
        return f"{name}, {self.symbol}" if self.symbol else name

    def text(self, value: Any) -> str:
        """One number or a list with its unit, lengths also in µm and nm; "?" while it is traced."""
        unit, numbers = self.symbol, ["?"] * np.size(value)
        if not checks.is_traced(value):
            known = np.atleast_1d(np.asarray(value))
            largest = np.abs(known).max(initial=0.0)
            if unit == "mm" and largest > 0:
                scale, unit = next((s, u) for s, u, least in _LENGTHS if largest >= least)
                known = known / scale
            numbers = [f"{number:.5g}" for number in known]
        text = numbers[0] if np.ndim(value) == 0 else f"({', '.join(numbers)})"
        return f"{text} {unit}".rstrip()


def quantity(
    unit: str = "",
    *,
    positive: bool = False,
    non_negative: bool = False,
    shape: tuple[int, ...] = (),
    optional: bool = False,
    many: bool = False,
    least: float | int | None = None,
    most: float | int | None = None,
    check: Callable[..., Any] | None = None,
) -> Quantity:
    """A finite number, or an array of a shape, in a unit.

    - `unit`: one of `UNITS`; other texts are for messages only.
    - `least`, `most`: ends of the range; give both, or `most` alone with `positive`.
    - `check`: in place of the ranges: called with the name and the value.
    """
    words = _IN_WORDS.get(unit, unit)
    if check is None and positive:
        limit = {} if most is None else {"most": most}
        check = functools.partial(checks.positive, unit=words, **limit)
    elif check is None and least is not None and most is not None:
        check = functools.partial(checks.between, unit=words, least=least, most=most)
    elif check is None and non_negative:
        check = functools.partial(checks.non_negative, unit=words)
    elif check is None:
        check = functools.partial(checks.finite, unit=words, shape=shape)
    least = 0.0 if positive or non_negative else least
    return Quantity(unit, check, positive, optional, least=least, most=most, many=many)


def whole(
    least: int, most: int | None = None, *, optional: bool = False, many: bool = False
) -> Quantity:
    """A whole number within limits."""
    check = functools.partial(checks.whole, least=least, most=most)
    return Quantity("", check, optional=optional, least=least, most=most, many=many)


def choice(options: Iterable[str], *, many: bool = False) -> Quantity:
    """One of several words."""
    options = tuple(options)
    check = functools.partial(checks.choice, options=options)
    return Quantity("", check, choices=options, many=many)


def unchecked(unit: str = "", parts: Mapping[str, Quantity] | None = None) -> Quantity:
    """The unit of a computed number, or of the parts of a dictionary."""
    return Quantity(unit, None, parts=parts or {})


def quantities(*owners: Any) -> dict[str, Quantity]:
    """Quantities of the attributes of a class or the parameters of a function, by name."""
    found: dict[str, Quantity] = {}
    for owner in owners:
        if dataclasses.is_dataclass(owner):
            given = {f.name: f.metadata.get("converter") for f in dataclasses.fields(owner)}
            found |= {name: one for name, one in given.items() if isinstance(one, Quantity)}
            found |= _annotated({f.name: f.type for f in dataclasses.fields(owner)})
        function = owner.__init__ if isinstance(owner, type) else owner
        found |= _annotated(getattr(function, "__annotations__", {}))
    return found


def check_fields(record: Any) -> None:
    """Check the attributes of a plain record by the quantities of their annotations."""
    with checks.on_host():
        for name, one in quantities(type(record)).items():
            one(getattr(record, name))


def _annotated(annotations: Mapping[str, Any]) -> dict[str, Quantity]:
    return {
        name: dataclasses.replace(one, name=name)
        for name, annotation in annotations.items()
        for one in getattr(annotation, "__metadata__", ())
        if isinstance(one, Quantity)
    }
