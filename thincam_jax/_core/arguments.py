"""Kinds of the objects that a public function is given, checked by its annotations."""

import functools
import inspect
import types
import typing
from collections.abc import Callable, Iterator
from typing import Any, Literal, ParamSpec, TypeVar

import numpy as np

from thincam_jax._core import checks

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")
_SIMPLE = {str: (str,), bool: (bool, np.bool_), int: (int, np.integer), type(None): (type(None),)}
_WORDS = {str: "a text", bool: "True or False", int: "a whole number", type(None): "None"}


def checked(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """The function, which raises TypeError in one line for an object of another kind.

    Checked are parameters annotated as classes of this package, texts, whole numbers and truth
    values, and as unions of these; what is an array or a number is checked by its field.
    """
    signature = inspect.signature(function)
    kinds = {name: _kinds(one.annotation) for name, one in signature.parameters.items()}
    wanted = {name: kind for name, kind in kinds.items() if kind}
    names = tuple(signature.parameters)

    @functools.wraps(function)
    def call(*args: _Parameters.args, **kwargs: _Parameters.kwargs) -> _Result:
        for name, value in (*zip(names, args, strict=False), *kwargs.items()):
            allowed = wanted.get(name)
            if allowed and not _is_one(value, allowed):
                words = " or ".join(_WORDS.get(kind) or _constructor(kind) for kind in allowed)
                raise TypeError(f"{name} is {checks.shown(value)}; give {words}")
        return function(*args, **kwargs)

    return call


def _constructor(kind: type) -> str:
    """What to write for an object of the class: "Sensor(shape, pitch, …)"."""
    if inspect.isabstract(kind) or kind.__name__.startswith("Abstract"):
        return f"an {kind.__name__}, such as {next(_concrete(kind), kind).__name__}"
    given = list(inspect.signature(kind).parameters.values())
    needed = [one.name for one in given if one.default is one.empty]
    return f"{kind.__name__}({', '.join([*needed, '…'][: len(given)])})"


def _concrete(kind: type) -> Iterator[type]:
    """The classes of that kind that objects are made of."""
    for one in kind.__subclasses__():
        inner = tuple(_concrete(one))
        yield from inner or (one,)


def _is_one(value: Any, allowed: tuple[type, ...]) -> bool:
    if isinstance(value, bool | np.bool_) and bool not in allowed:
        return False
    return any(isinstance(value, _SIMPLE.get(kind, kind)) for kind in allowed)


def _kinds(annotation: Any) -> tuple[type, ...]:
    """The classes that an annotation allows; none where it allows what is not checked here."""
    origin = typing.get_origin(annotation)
    if origin in (typing.Union, types.UnionType):
        parts = [_kinds(part) for part in typing.get_args(annotation)]
        return tuple(dict.fromkeys(sum(parts, ()))) if all(parts) else ()
    if origin is Literal:
        return (str,)
    own = isinstance(annotation, type) and annotation.__module__.startswith("thincam_jax")
    return (annotation,) if own or annotation in _SIMPLE else ()
