"""Annotations checked at each call, where jaxtyping's own decorator takes a sixth of the time."""

import dataclasses
import functools
import inspect
import types
import typing
from typing import Any

import jaxtyping
from beartype import BeartypeConf, beartype

JAXTYPED = jaxtyping.jaxtyped
check = beartype(conf=BeartypeConf(violation_type=jaxtyping.TypeCheckError))
SHAPES = JAXTYPED("context")  # of one call: lengths of the same name agree


def has_shape(hint: Any) -> bool:
    """Whether a hint may name lengths."""
    if isinstance(hint, type) and not isinstance(hint, types.GenericAlias):
        return hint.__module__.startswith("jaxtyping")
    return isinstance(hint, typing.TypeVar) or any(map(has_shape, typing.get_args(hint)))


def checked(what: Any = None, *, typechecker: Any = None) -> Any:
    """A function, or a dataclass with its `__init__`: takes the place of `jaxtyping.jaxtyped`.

    jaxtyping binds the arguments and checks them twice, which names a fault more precisely; here
    beartype alone checks, in a context of shapes only where an annotation has one.
    """
    if what is None:
        return checked
    if inspect.isclass(what):
        init = vars(what).get("__init__")
        if dataclasses.is_dataclass(what) and init and not hasattr(init, "__wrapped__"):
            what.__init__ = checked(init)
        return what
    hints = what.__annotations__.values()
    if not hints:
        return what
    if any(isinstance(hint, str) for hint in hints):  # names of classes that may not be there yet
        return JAXTYPED(what, typechecker=check)
    function, named = None, any(map(has_shape, hints))

    @functools.wraps(what)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal function
        if jaxtyping.config.jaxtyping_disable:
            return what(*args, **kwargs)
        function = function or check(what)  # at the first call: most are not made in one process
        if not named:
            return function(*args, **kwargs)
        with SHAPES:
            return function(*args, **kwargs)

    return call
