"""The registry of kinds, and sections of files from constructors."""

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

import pytest
from pydantic import BaseModel

from helpers import ROOT
from thincam_jax._core.quantity import FieldError, quantity, whole
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.kinds import KINDS, load_experiment, read_kind
from thincam_jax.commands.run_folder import FILE_KEYS
from thincam_jax.commands.schema import descriptions, section


@pytest.mark.parametrize("name", KINDS)
def test_its_parts_are_there(name):
    kind = KINDS[name]
    section = kind.part(kind.section)
    declared = section.model_fields.get("kind")
    assert (declared is None) == (name == "study")
    assert declared is None or declared.annotation.__args__ == (name,)
    assert (kind.command != "capture") == bool(kind.build and kind.run)
    assert all(callable(kind.part(place)) for place in (kind.build, kind.run) if place)
    assert not kind.example or read_kind(ROOT / f"configs/{kind.example}.yaml") is kind


def test_an_unknown_kind_is_told(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("name: a\nkind: masks\n")
    told = (
        "'masks' is unknown; write refocus, screen, design, cells, capture, denoiser or trained, or"
    )
    with pytest.raises(ConfigError, match=told):
        load_experiment(path)


def texts(annotation, key="", seen=()):
    """Keys below a section whose values are free texts."""
    if annotation is str:
        yield key
    elif isinstance(annotation, type) and issubclass(annotation, BaseModel):
        for name, field in annotation.model_fields.items() if annotation not in seen else ():
            yield from texts(field.annotation, name, (*seen, annotation))
    for inner in get_args(annotation):
        yield from texts(inner, key, seen)


@pytest.mark.parametrize("name", KINDS)
def test_every_file_that_a_kind_names_is_an_input(name):
    """A new key of texts belongs to the keys of files, or to those that name none.

    Runs of captures and their stores, which have others, take nothing up of earlier ones.
    """
    words = {"name", "title", "notes", "licence", "image", "held_out", "driver", "method"}
    words |= {"published", "images", "split"}  # by names of methods, of targets, of parts of a set
    captures = {"matrix", "alignment", "options", "photographs", "trigger"}
    captures = captures if name == "capture" else set()
    found = set(texts(KINDS[name].part(KINDS[name].section)))
    assert found <= words | captures | {*FILE_KEYS}


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


def test_values_are_read_with_their_units_and_written_back():
    made = section(Stage)
    read = made.model_validate({"travel": "25 um", "corners": ["1 mm", "2 m"], "axis": "y"})
    assert read.build() == Stage(0.025, (1.0, 2000.0), axis="y")
    dumped = read.model_dump(mode="json", exclude_none=True)
    assert dumped["travel"] == "0.025 mm" and dumped["steps"] == 16
    assert made.model_validate(dumped) == read


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
