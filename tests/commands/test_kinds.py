"""The registry of kinds: every part that it names is there, and files go where they belong."""

from typing import get_args

import pytest
from pydantic import BaseModel

from helpers import ROOT
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.kinds import KINDS, kind_of, load_experiment, read_kind
from thincam_jax.commands.run_folder import FILE_KEYS


@pytest.mark.parametrize("name", KINDS)
def test_its_parts_are_there(name):
    kind = KINDS[name]
    section = kind.part(kind.section)
    declared = section.model_fields.get("kind")
    assert (declared is None) == (name == "study")
    assert declared is None or declared.annotation.__args__ == (name,)
    assert (kind.command in ("run", "train")) == bool(kind.build and kind.run)
    assert all(callable(kind.part(place)) for place in (kind.build, kind.run) if place)
    assert not kind.example or read_kind(ROOT / f"configs/{kind.example}.yaml") is kind


def test_a_file_goes_to_its_command():
    config = load_experiment(ROOT / "configs/rig_virtual.yaml", command="capture")
    assert kind_of(config) is KINDS["capture"]
    with pytest.raises(ConfigError, match="quick.yaml: is a study; give it to 'thincam run'"):
        load_experiment(ROOT / "configs/quick.yaml", command="train")


def test_an_unknown_kind_is_told(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("name: a\nkind: masks\n")
    told = (
        "'masks' is unknown; write 'kind: refocus' or 'kind: screen', or leave it out for a study"
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
    words |= {"published", "images"}  # by names of methods, and of targets
    captures = {"matrix", "alignment", "options", "trigger"} if name == "capture" else set()
    found = set(texts(KINDS[name].part(KINDS[name].section)))
    assert found <= words | captures | {*FILE_KEYS}
