"""Attributes of packages: their modules, and the nearest name where one is misspelt."""

import ast
import importlib
import importlib.util
import pkgutil
import sys
from collections.abc import Callable
from typing import Any

from thincam_jax._core.text import nearest


def lazy_face(package: str) -> tuple[Any, Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package whose names stand in its stub, `__init__.pyi`.

    Each is imported at its first use, so that a room is there before what it computes with.
    """
    places = {
        alias.name: f"{'.' * node.level}{node.module or alias.name}"
        for node in ast.parse(pkgutil.get_data(package, "__init__.pyi") or b"").body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }

    def named(name: str) -> Any:
        module = importlib.import_module(places[name], package)
        return module if places[name] == f".{name}" else getattr(module, name)

    return modules_of(package, named), lambda: sorted(places)


def modules_of(package: str, names: Callable[[str], Any] | None = None) -> Any:
    """`__getattr__` of a package, by which `tc.imaging.operators` needs no import of its own.

    `names` gets the names of a lazy package. A module is imported at its first use. Any other name
    is an `AttributeError` that tells the nearest ones. A type checker sees `Any` and goes on to
    report unknown names.
    """

    def attribute(name: str) -> Any:
        known, path = dir(sys.modules[package]), f"{package}.{name}"
        if names is not None and name in known:
            return names(name)
        if not name.startswith("_") and importlib.util.find_spec(path):
            return importlib.import_module(path)
        near = [one for one in known if one.startswith(name) or _initials(one) == name.upper()]
        near = (near or nearest(name, [one for one in known if not one.startswith("_")]))[:3]
        hint = f": did you mean {' or '.join(near)}?" if near else ""
        raise AttributeError(f"{package} has no name {name}{hint}", name=name)

    return attribute


def _initials(name: str) -> str:
    """Capitals of a name, such as FZA of FresnelZoneAperture."""
    return "".join(letter for letter in name if letter.isupper())
