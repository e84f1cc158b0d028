"""Options of promised functions are given by name, so that a call reads without the page."""

import inspect
import operator
import types
import typing

import numpy as np
import pytest
from test_public_faces import promised

import thincam_jax as tc

PLAIN = (int, float, complex, str, bool, np.generic, tuple)
# Objects that stand beside a camera; all numbers of the light and of the object are named.
BESIDE_A_CAMERA = {"camera", "scene", "light", "pixels", "plane", "capture"}
FUNCTIONS = [
    name
    for name in promised(packages=False)
    for made in [operator.attrgetter(name.removeprefix("thincam_jax."))(tc)]
    if callable(made) and not inspect.isclass(made)
]


def positional(name: str) -> list[inspect.Parameter]:
    function = operator.attrgetter(name.removeprefix("thincam_jax."))(tc)
    found = inspect.signature(function).parameters.values()
    return [one for one in found if one.kind not in (one.KEYWORD_ONLY, one.VAR_KEYWORD)]


def is_plain(annotation: object) -> bool:
    """Whether it is a number, a text, a truth value or a tuple of them, and not also an object."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        return all(is_plain(one) for one in parts if one is not types.NoneType)
    if origin is typing.Annotated:
        return is_plain(parts[0])
    return origin in (tuple, typing.Literal) or (
        isinstance(annotation, type) and issubclass(annotation, PLAIN)
    )


@pytest.mark.parametrize("name", FUNCTIONS)
def test_options_are_given_by_name(name):
    """What has a default is one, but for objects such as a solver; beside a camera all numbers."""
    for one in positional(name):
        option = one.default is not one.empty
        assert not (option and is_plain(one.annotation)), f"{name}: {one.name} after *"
    names = [one.name for one in positional(name)]
    if names[:1] == ["camera"]:
        assert set(names) <= BESIDE_A_CAMERA


def test_the_check_finds_plain_options():
    assert is_plain(int) and is_plain(float | None) and is_plain(tuple[int, int] | None)
    assert not is_plain(tc.Wiener | str | None) and not is_plain(tc.Scene)
