"""Kinds of the objects that a public function or class is given, checked by its annotations."""

import dataclasses
import functools
import inspect
import operator
import os
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import AbstractArray, PRNGKeyArray

from thincam_jax._core import checks
from thincam_jax._core.quantity import Quantity, quantities

_Public = TypeVar("_Public", bound=Callable[..., Any])


@dataclass(frozen=True)
class _Kind:
    """One of the kinds that an argument may be of; `words` say what to give."""

    holds: Callable[[Any], bool]
    words: Callable[[], str]


_Kinds = tuple[_Kind, ...]

_SHORT = ("float16", "bfloat16", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16)))


def any_rank(function: _Public) -> _Public:
    """The function, where JAX's option `jax_numpy_rank_promotion` is for other arrays alone."""

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        if jax.config.jax_numpy_rank_promotion == "allow":  # pyright: ignore
            return function(*args, **kwargs)
        with jax.numpy_rank_promotion("allow"):
            return function(*args, **kwargs)

    return typing.cast(_Public, call)


def checked(public: _Public) -> _Public:
    """The function or class, which raises TypeError in one line for an argument of another kind.

    Checked are parameters annotated as classes of this package, texts, numbers, truth values,
    functions, paths, random keys and arrays (their dimensions, and that they hold finite numbers),
    as tuples, sequences and mappings, as unions of these, and by a `Quantity`.
    """
    if isinstance(public, type):
        setattr(public, "__init__", checked(public.__init__))  # noqa: B010
        return typing.cast(_Public, public)
    named = inspect.signature(public).parameters
    names, ranges = tuple(named), quantities(public)
    kinds = {name: _kinds(one.annotation) for name, one in named.items()}
    # A quantity tells one number of another kind itself.
    kinds = {name: kind for name, kind in kinds.items() if name not in ranges or ranges[name].many}

    @any_rank
    @functools.wraps(public)
    def call(*args: Any, **kwargs: Any) -> Any:
        given = zip((*names, *[""] * len(args)), args, strict=False)
        args = tuple(_native(kinds.get(name), value) for name, value in given)
        kwargs = {name: _native(kinds.get(name), value) for name, value in kwargs.items()}
        refuse_unsound(names, args, kwargs)
        args, kwargs = _settled(args), {name: _settled(one) for name, one in kwargs.items()}
        for name, value in (*zip(names, args, strict=False), *kwargs.items()):
            allowed = kinds.get(name)
            if allowed and not any(kind.holds(value) for kind in allowed):
                raise TypeError(f"{name} is {checks.shown(value)}; give {_words(allowed)}")
            if name in ranges:
                with checks.on_host():
                    ranges[name](value)
        return public(*args, **kwargs)

    return typing.cast(_Public, call)


def _native(allowed: _Kinds | None, value: Any) -> Any:
    """An array of another library, or a masked one, as one of NumPy where its kind is checked."""
    if not allowed or not (checks.is_foreign(value) or isinstance(value, np.ma.MaskedArray)):
        return value
    kept = checks.is_foreign(value) and any(kind.holds(value) for kind in allowed)
    return value if kept else checks.native(value)


def refuse_unsound(names: Iterable[str], args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
    """Refuse numbers beyond those of floats, and lists inside themselves."""
    for name, value in (*zip(names, args, strict=False), *kwargs.items()):
        if isinstance(value, int) and value.bit_length() > checks.MOST_BITS:
            raise ValueError(f"{name} is {checks.shown(value)}; give a smaller one")
        if isinstance(value, list | tuple) and checks.holds_itself(value):
            raise TypeError(f"{name} is a list inside itself; give numbers")


def _settled(value: Any) -> Any:
    """Modules, alone or in lists, with the numbers of any type that `equinox.tree_at` put in.

    They become arrays, and are checked, as when the module is made.
    """
    if isinstance(value, list | tuple) and isinstance(next(iter(value), None), eqx.Module):
        parts = [_settled(one) for one in value]
        return value if all(map(operator.is_, parts, value)) else type(value)(parts)
    if not isinstance(value, eqx.Module):
        return value
    if not any(map(_is_plain, jax.tree.leaves(value))):
        return value
    fields = {field.name: field.metadata for field in dataclasses.fields(value)}
    parts = {}
    for name, one in vars(value).items():
        is_plain = not fields[name].get("static") and _is_plain(one)
        convert = fields[name].get("converter") if is_plain else None
        parts[name] = convert(one) if isinstance(convert, Quantity) else _settled(one)
    if all(one is vars(value)[name] for name, one in parts.items()):
        return value
    made = object.__new__(type(value))
    for name, one in parts.items():
        object.__setattr__(made, name, one)
    return made


def _is_plain(leaf: Any) -> bool:
    """Whether a converter of numbers would change its type: Python's, whole, half or swapped."""
    if isinstance(leaf, jax.Array):
        return not checks.is_traced(leaf) and leaf.dtype in _SHORT
    if isinstance(leaf, np.ndarray | np.generic):
        return leaf.dtype.char not in "fdFD" or not leaf.dtype.isnative
    return isinstance(leaf, int | float | complex | str)


def _words(kinds: _Kinds) -> str:
    """Allowed kinds in words, each once."""
    words = dict.fromkeys(kind.words() for kind in kinds)
    if "a number" in words:
        words.pop("a whole number", None)
    return " or ".join(words)


def _kinds(annotation: Any) -> _Kinds:
    """The kinds that an annotation allows; none where it allows what is not checked here."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        return _kinds(parts[0])
    if origin in (typing.Union, types.UnionType):
        each = [_kinds(part) for part in parts]
        return sum(each, ()) if all(each) else ()
    if origin in (tuple, Sequence, Iterable):
        several = _several(parts, fixed=origin is tuple and parts[-1:] != (...,))
        # What a generator yields is not known before it is used.
        drawn = _Kind(lambda value: isinstance(value, Iterator), lambda: "a generator")
        return (several, drawn) if origin is Iterable else (several,)
    plain = _PLAIN.get(str if origin is Literal else origin or annotation)
    if plain is not None or not isinstance(annotation, type):
        return () if plain is None else (plain,)
    if issubclass(annotation, AbstractArray):
        return (_array(annotation),)
    if annotation.__module__.startswith("thincam_jax"):
        return (
            _Kind(lambda value: isinstance(value, annotation), lambda: _constructor(annotation)),
        )
    return ()


def _plain(words: str, *classes: Any) -> _Kind:
    """Kind of value: of these classes, and a truth value only where it is one of them."""

    def holds(value: Any) -> bool:
        is_truth = isinstance(value, bool | np.bool_)
        return isinstance(value, classes) and (bool in classes or not is_truth)

    return _Kind(holds, lambda: words)


def _is_number(value: Any) -> bool:
    """One real number, which may be traced, infinite or NaN."""
    if not isinstance(value, int | float | np.ndarray | np.generic | jax.Array) or np.ndim(value):
        return False
    dtype = np.dtype(type(value)) if isinstance(value, int | float) else value.dtype
    return dtype.kind in "fiu"


_PLAIN: dict[Any, _Kind] = {
    str: _plain("a text", str),
    bool: _plain("True or False", bool, np.bool_),
    int: _plain("a whole number", int, np.integer),
    np.integer: _plain("a whole number", int, np.integer),
    float: _Kind(_is_number, lambda: "a number"),
    complex: _plain("a number", int, float, complex, np.number),
    type(None): _plain("None", type(None)),
    Mapping: _plain("a dictionary", Mapping),
    dict: _plain("a dictionary", dict),
    Callable: _Kind(callable, lambda: "a function"),
    os.PathLike: _plain("a path", os.PathLike),
    np.ndarray: _plain("an array", np.ndarray),
}


# Of random keys, new and old ones.
_KEYS = {str(one.dtypes) for one in typing.get_args(PRNGKeyArray)}


def _several(parts: tuple[Any, ...], *, fixed: bool) -> _Kind:
    """A tuple of these kinds, or a sequence of one kind."""
    each = [_kinds(part) for part in parts if part is not ...]

    def holds(value: Any) -> bool:
        is_array = isinstance(value, np.ndarray | jax.Array) and value.ndim
        if not (is_array or isinstance(value, tuple | list)):
            return False
        if fixed and len(value) != len(each):
            return False
        kinds = each if fixed else each * len(value)
        pairs = zip(value, kinds, strict=True)
        return all(not kind or any(k.holds(one) for k in kind) for one, kind in pairs)

    def words() -> str:
        one = _words(sum(each, ())) or "an object"
        return f"{f'{len(each)} values' if fixed else 'a sequence'}, each {one}"

    return _Kind(holds, words)


def _array(annotation: Any) -> _Kind:
    """An array of as many dimensions, of finite numbers, or of truth values alone."""
    dtypes, variadic = str(annotation.dtypes), annotation.index_variadic is not None
    if dtypes in _KEYS:
        return _Kind(lambda value: isinstance(value, annotation), lambda: "jax.random.key(seed)")
    kinds = "b" if dtypes == str(("bool", "bool_")) else "fiub"
    kinds += "c" if "complex" in dtypes or "Any" in dtypes else ""
    least = len(annotation.dims) - variadic

    def holds(value: Any) -> bool:
        if not isinstance(value, np.ndarray | np.generic | jax.Array | int | float):
            return False
        array = np.asarray(value) if isinstance(value, int | float) else value
        fits = array.ndim == least or (variadic and array.ndim > least)
        if not fits or array.dtype.kind not in kinds:
            return False
        return checks.is_traced(array) or bool(np.isfinite(np.asarray(array)).all())

    sides = f" ({', '.join(annotation.dim_str.split())})" if annotation.dims else ""
    what = "truth values" if kinds == "b" else "finite numbers"
    return _Kind(holds, lambda: f"an array{sides} of {what}" if sides else "a finite number")


def _constructor(kind: type) -> str:
    """Call that makes an object of the class: "Sensor(shape, pitch, …)"."""
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
