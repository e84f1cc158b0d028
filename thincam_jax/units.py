"""Units: plain floats with the millimetre and the radian equal to one.

Every length in the package is in millimetres and every angle in radians, so a quantity is written
by multiplication and read by division::

    from thincam_jax.units import deg, nm, um

    wavelength = 500 * nm        # 5e-4 (mm)
    pitch = 5.5 * um             # 5.5e-3 (mm)
    tilt = 61.2 * deg            # 1.068 (rad)
    print(wavelength / nm)       # 500.0

The derived units follow: the curvature β of a Fresnel zone aperture is in rad/mm², a spatial
frequency in cycles/mm. `parse_quantity` reads the quantities with units in experiment files.
"""

from __future__ import annotations

import functools
import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pint

nm: float = 1e-6
um: float = 1e-3
mm: float = 1.0
m: float = 1e3

rad: float = 1.0
mrad: float = 1e-3
deg: float = math.pi / 180.0


@dataclass(frozen=True)
class _Kind:
    """Name, accepted units and canonical unit of one kind of quantity."""

    unit: str  # of the package, as a file has it
    name: str  # with its article, as it stands in a sentence
    target: dict[str, str]  # root units, as pint writes them -> the package's unit for them
    advice: str  # for a missing unit or a wrong dimension
    examples: str  # for an unknown unit


# The one table of what files write with a unit; `_core.quantity` has the rest.
KINDS = {
    "length": _Kind(
        "mm",
        "a length",
        {"meter": "millimeter"},
        'write a length such as "180 mm"',
        '"500 nm", "5.5 um", "180 mm" or "0.25 m"',
    ),
    "wavelength": _Kind(
        "mm",
        "a wavelength",
        {"meter": "millimeter"},
        'write a wavelength such as "500 nm"',
        '"500 nm" or "0.5 um"',
    ),
    "angle": _Kind(
        "rad",
        "an angle",
        {"radian": "radian"},
        'write an angle such as "61.2 deg"',
        '"61.2 deg", "30 arcmin", "5 mrad" or "1.07 rad"',
    ),
    "curvature": _Kind(
        "rad/mm^2",
        "a curvature",
        {
            "radian / meter ** 2": "radian / millimeter ** 2",
            "1 / meter ** 2": "1 / millimeter ** 2",
        },
        'write a curvature such as "25 rad/mm^2"',
        '"25 rad/mm^2", "25 rad/mm**2" or "25 /mm^2"',
    ),
    "time": _Kind(
        "s",
        "a time",
        {"second": "second"},
        'write a time such as "5 ms"',
        '"50 us", "5 ms" or "2 s"',
    ),
}

# Units that files have most, each in the package's: pint takes half a second to start.
_COMMON = {
    "length": {"nm": nm, "um": um, "mm": mm, "m": m},
    "wavelength": {"nm": nm, "um": um},
    "angle": {"deg": deg, "mrad": mrad, "rad": rad},
    "curvature": {"rad/mm^2": 1.0},
    "time": {"ms": 1e-3, "s": 1.0},
}

# What a quantity of another kind is called, by its root units as pint writes them.
_NAMES = {
    "dimensionless": "a pure number",
    "meter": "a length",
    "radian": "an angle",
    "radian / meter ** 2": "a curvature",
    "1 / meter ** 2": "a curvature",
    "second": "a time",
    "gram": "a mass",
    "kelvin": "a temperature",
    "ampere": "a current",
    "meter ** 2": "an area",
    "meter ** 3": "a volume",
    "1 / second": "a frequency",
    "radian / second": "an angular frequency",
    "1 / meter": "a spatial frequency",
    "radian / meter": "an angular spatial frequency",
    "meter / second": "a speed",
    "gram * meter ** 2 / second ** 2": "an energy",
}

# A number, then a product of unit names with one-digit exponents. The grammar is narrow on purpose:
# pint would also evaluate expressions, and a file holds quantities, not programs.
_NUMBER = re.compile(
    r"[+-]?(?:(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|nan\b|inf(?:inity)?\b)", re.IGNORECASE
)
_TERM = r"(?:[^\W\d]\w*|°[CF]?|%)(?:\s*(?:\*\*|\^)\s*[+-]?\d(?!\d))?"
_UNITS = re.compile(rf"(?:1?\s*/\s*)?{_TERM}(?:(?:\s*[*/·]\s*|\s+){_TERM})*")


_LONGEST = 80  # signs of a quantity


@functools.cache
def _registry() -> pint.UnitRegistry:
    """The unit registry, made at the first use: importing pint takes a few tenths of a second."""
    import pint

    return pint.UnitRegistry()


def parse_quantity(text: object, kind: str) -> float:
    """Read a quantity with its unit and return it in the package's units.

    **Arguments:**

    - `text`: a string such as `"180 mm"`, `"61.2 deg"` or `"25 rad/mm^2"`, or a scalar pint
      quantity of any registry. A number without a unit is refused: no unit is guessed.
    - `kind`: `"length"`, `"wavelength"`, `"angle"`, `"time"` or `"curvature"` (β of a Fresnel
      zone aperture; the radian may be left out, `"25 /mm^2"`).

    **Returns:**

    A float: mm for a length, radians for an angle, s for a time, rad/mm² for a curvature. The
    sign is kept; a range is the business of whoever takes the value.

    **Raises:**

    - `ValueError`, one line that says what was given and what to write: no unit, a unit of another
      dimension, an unknown unit, a value that is not finite, or text that is no quantity.
    """
    if kind not in KINDS:
        allowed = ", ".join(f'"{name}"' for name in KINDS)
        raise ValueError(f"{kind!r} is not a kind of quantity: use one of {allowed}")
    wanted = KINDS[kind]
    if isinstance(text, str):
        text = " ".join(text.split())
        if len(text) > _LONGEST:
            raise ValueError(f'"{text[:_LONGEST]}…" is not {wanted.name}: {wanted.advice}')
        number, _, unit = text.partition(" ")
        if unit in _COMMON[kind] and _NUMBER.fullmatch(number) and math.isfinite(float(number)):
            return float(number) * _COMMON[kind][unit]
        shown = f'"{text}"'
        quantity = _read(text, wanted)
    elif hasattr(text, "magnitude") and hasattr(text, "to_root_units"):
        shown = f'"{text}"'
        quantity: Any = text
        if f"{quantity.units:D}" == "dimensionless":
            raise ValueError(f"{quantity.magnitude} has no unit: {wanted.advice}")
    elif isinstance(text, (int, float)) and not isinstance(text, bool):
        raise ValueError(f"{text} has no unit: {wanted.advice}")
    else:
        raise ValueError(f"{text!r} is not {wanted.name}: {wanted.advice}")
    return _convert(quantity, shown, wanted)


def _read(text: str, wanted: _Kind) -> Any:
    """Split text into a number and a unit and let pint read the unit."""
    import pint

    number = _NUMBER.match(text)
    if number is None:
        raise ValueError(f'"{text}" does not begin with a number: {wanted.advice}')
    units = text[number.end() :].strip()
    if not units:
        raise ValueError(f"{text} has no unit: {wanted.advice}")
    if not _UNITS.fullmatch(units):
        raise ValueError(f'"{text}" is not a number and a unit: {wanted.advice}')
    if units.startswith("/"):
        units = "1" + units
    try:
        parsed = _registry().parse_units(units.replace("·", "*"))
    except pint.UndefinedUnitError as error:
        unknown = error.unit_names if isinstance(error.unit_names, str) else error.unit_names[0]
        raise ValueError(
            f'"{text}" has the unknown unit "{unknown}": '
            f"write {wanted.name} such as {wanted.examples}"
        ) from None
    except (pint.PintError, ValueError):
        raise ValueError(f'"{text}" is not a number and a unit: {wanted.advice}') from None
    return _registry().Quantity(float(number.group()), parsed)


def _convert(quantity: Any, shown: str, wanted: _Kind) -> float:
    """Check the dimension and the value of a pint quantity and return its number in our units."""
    one = type(quantity)(1.0, quantity.units)
    # Root units keep the radian, which pint's dimensions drop: a percentage is not an angle.
    root = f"{one.to_root_units().units:D}"
    target = wanted.target.get(root)
    if target is None:
        found = _NAMES.get(root, f"a quantity in {quantity.units:D}")
        raise ValueError(f"{shown} is {found}, not {wanted.name}: {wanted.advice}")
    try:
        value = float(quantity.magnitude) * _decimal(one.to(target).magnitude)
    except (TypeError, ValueError):
        raise ValueError(f"{shown} is not one real number: {wanted.advice}") from None
    except OverflowError:
        value = math.inf
    if not math.isfinite(value):
        raise ValueError(f"{shown} is not finite: {wanted.advice}")
    return value


def _decimal(factor: float) -> float:
    """Undo the rounding of a power of ten, so that "500 nm" is 500 * nm to the last bit.

    Pint multiplies its factors out: a nanometre comes as 1.0000000000000002e-06 mm.
    """
    nearest = float(f"1e{round(math.log10(factor))}")
    return nearest if math.isclose(factor, nearest, rel_tol=1e-14) else factor
