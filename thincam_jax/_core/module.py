"""Modules that print the values of their numbers, with units."""

import dataclasses
import inspect
from typing import TYPE_CHECKING, Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import wadler_lindig as wl

from thincam_jax._core.arguments import any_rank, refuse_unsound
from thincam_jax._core.quantity import Quantity, unchecked
from thincam_jax._core.text import nearest

_MOST = 4  # numbers of an array that are shown, not counted
_PLAIN = unchecked()
_Kind = TypeVar("_Kind")


if TYPE_CHECKING:  # a metaclass of one's own hides the arguments of a module
    _Module = eqx.Module
else:

    class _Sound(type(eqx.Module)):
        """Classes whose arguments hold no list inside itself: equinox walks through them first."""

        def __call__(cls, *args: Any, **kwargs: Any) -> Any:
            if any(isinstance(one, list | tuple) for one in (*args, *kwargs.values())):
                refuse_unsound(inspect.signature(cls).parameters, args, kwargs)
            return super().__call__(*args, **kwargs)

    class _Module(eqx.Module, metaclass=_Sound):
        """Module of a class whose arguments are sound."""


class AnyRank(_Module):
    """Modules whose methods add up arrays of any ranks, whatever JAX's option says."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for name, one in list(vars(cls).items()):
            if inspect.isfunction(one) and (name == "__call__" or not name.startswith("_")):
                setattr(cls, name, any_rank(one))


class Module(AnyRank):
    """An `equinox.Module` whose repr shows scalars by value and unit; "?" while they are traced.

    Larger arrays are shown by type and shape. None is left out, and so is what is as by default,
    unless a converter says that it was to be chosen.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for name, field in vars(cls).items():
            converter = getattr(field, "metadata", {}).get("converter")
            if isinstance(converter, Quantity):
                converter.name = name

    def replace(self: _Kind, **changes: Any) -> _Kind:
        """This object with other values of some arguments, as `camera.replace(distance=3.0)`."""
        names = list(inspect.signature(type(self)).parameters)
        for name in changes:
            if name not in names:
                raise TypeError(f"{type(self).__name__} has no {name}; give {_near(self, name)}")
        kept = {name: getattr(self, name) for name in names if hasattr(self, name)}
        return type(self)(**kept | changes)

    def __pdoc__(self, **kwargs: Any) -> wl.AbstractDoc:
        """Document for equinox's printer, of this object or of one inside another."""
        named = [(f, getattr(self, f.name, None)) for f in dataclasses.fields(self) if f.repr]
        parts = [
            wl.TextDoc(f"{f.name}=") + wl.pdoc(_shown(f.metadata.get("converter"), value), **kwargs)
            for f, value in named
            if value is not None and ("converter" in f.metadata or value is not f.default)
        ]
        name = wl.TextDoc(f"{type(self).__name__}(")
        return wl.bracketed(name, parts, wl.comma, wl.TextDoc(")"), kwargs["indent"])


def _near(made: Any, name: str) -> str:
    """Name to give in place of an unknown argument; it may be that of a part."""
    names = list(inspect.signature(type(made)).parameters)
    for part in names:
        whole = getattr(made, part, None)
        if isinstance(whole, Module) and name in inspect.signature(type(whole)).parameters:
            return f"{part}=….{part}.replace({name}=…)"
    return ", ".join(nearest(name, names) or names)


def _shown(converter: Any, value: Any) -> Any:
    """A few numbers with the unit of the field, or of their keys; anything else as it is."""
    quantity = converter if isinstance(converter, Quantity) else _PLAIN
    if isinstance(value, dict):
        return {key: _shown(quantity.parts.get(str(key)), one) for key, one in value.items()}
    if not isinstance(value, float | np.ndarray | jax.Array):
        return value
    is_number = jnp.issubdtype(jnp.result_type(value), jnp.number)
    if np.ndim(value) > 1 or np.size(value) > _MOST or not is_number:
        return value
    return wl.TextDoc(quantity.text(value))
