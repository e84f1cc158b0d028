"""Sections of files from constructors: keys, units, checks and faults."""

from dataclasses import dataclass
from typing import Annotated, Literal

import pydantic
import pytest

from thincam_jax._core.quantity import FieldError, quantity, whole
from thincam_jax.commands.schema import descriptions, section


@dataclass(frozen=True)
class Stage:
    """A stage.

    - `travel`: how far it goes, mm. It is
      measured from the middle.
    - `slow`, `fast`: of its speeds.
    """

    travel: Annotated[float, quantity("mm", positive=True)]
    corners: Annotated[tuple[float, float], quantity("mm", shape=(2,))] = (0.0, 0.0)
    steps: Annotated[int, whole(1, 64)] = 16
    axis: Literal["x", "y"] = "x"
    home: Annotated[float | None, quantity("mm", optional=True)] = None

    def __post_init__(self):
        if self.home is not None and abs(self.home) > self.travel:
            raise FieldError("home lies beyond the travel; give less", "home")


def faults(made, **given):
    with pytest.raises(pydantic.ValidationError) as error:
        made.model_validate(given)
    (fault,) = error.value.errors()
    return (*fault["loc"], *getattr(fault.get("ctx", {}).get("error"), "place", ())), fault["msg"]


def test_values_are_read_with_their_units_and_written_back():
    made = section(Stage)
    read = made.model_validate({"travel": "25 um", "corners": ["1 mm", "2 m"], "axis": "y"})
    assert read.build() == Stage(0.025, (1.0, 2000.0), axis="y")
    dumped = read.model_dump(mode="json", exclude_none=True)
    assert dumped["travel"] == "0.025 mm" and dumped["steps"] == 16
    assert made.model_validate(dumped) == read


@pytest.mark.parametrize(
    ("given", "key", "message"),
    [
        ({"travel": 25}, ("travel",), "25 has no unit"),
        ({"travel": "-1 mm"}, ("travel",), "not positive"),
        ({"travel": "1 mm", "steps": 65}, ("steps",), "whole number from 1 to 64"),
        ({"travel": "1 mm", "axis": "z"}, ("axis",), "'x' or 'y'"),
        ({"travel": "1 mm", "corners": ["1 mm", 2]}, ("corners", 1), "2 has no unit"),
        ({"travel": "1 mm", "home": "2 mm"}, ("home",), "beyond the travel"),
        ({"travel": "1 mm", "colour": 1}, ("colour",), "not permitted"),
        ({}, ("travel",), "required"),
    ],
)
def test_faults_at_their_keys(given, key, message):
    location, told = faults(section(Stage), **given)
    assert location == key and message in told


def test_parts_of_a_constructor_and_other_defaults():
    part = section(Stage, only=("travel", "steps"), defaults={"travel": None, "steps": 8})
    assert list(part.model_fields) == ["travel", "steps"]
    read = part.model_validate({})
    assert (read.travel, read.steps) == (None, 8)
    assert read.build(travel=1.0, axis="y") == Stage(1.0, steps=8, axis="y")
    assert "steps" not in section(Stage, without=("steps",)).model_fields


def test_descriptions_of_a_docstring():
    about = descriptions(Stage)
    assert about["travel"] == "how far it goes, mm. It is measured from the middle."
    assert about["slow"] == about["fast"] == "of its speeds."
    assert section(Stage).model_fields["travel"].description == about["travel"]
