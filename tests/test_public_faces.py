"""What every public function keeps, and the names that versions keep."""

import ast
import dataclasses
import functools
import importlib
import inspect
import operator
import re
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray
from test_docs import PACKAGE, pages

import thincam_jax as tc
from helpers import ROOT
from thincam_jax.design.phase_retrieval import contour_target
from thincam_jax.units import um

FACES = (
    *("design", "hardware", "learn", "lensless", "measured", "plot", "reconstruction", "studies"),
    *("imaging.operators", "imaging.targets", "lensless.masks", "waveguide"),
    *("measured.calibration", "reconstruction.depth"),
)
# Modules of which scripts and tests call functions by their path.
MODULES = (
    *("design.end_to_end", "design.fronts", "design.match"),
    *("design.objectives", "design.phase_mask", "design.phase_retrieval"),
    *("waveguide.design.plate", "design.ranking", "design.sensitivity"),
    "design.training",
    "lensless.masks.phase",
    *("waveguide.measured.screen_fit", "measured.exposures", "measured.sensor"),
    *("reconstruction.depth.find", "reconstruction.problem"),
    *("studies.evaluate", "studies.prepared", "hardware.studies.images", "waveguide.distance"),
    *("studies.result", "studies.study", "waveguide.colours"),
    *("waveguide.rays", "waveguide.screen_to_sensor"),
)
# Called by the package with keys that it draws, or inside jit.
WITHIN = {"linear_objective", "match_objective", "restored_objective"}
WITHIN |= {"FrontSearch", "Training", "TrainingDescents", "adjoint_error"}


def faces() -> dict[str, object]:
    modules = [tc, *(importlib.import_module(f"thincam_jax.{name}") for name in FACES)]
    found = {name: getattr(face, name) for face in modules for name in dir(face) if name[0] != "_"}
    for module in (importlib.import_module(f"thincam_jax.{name}") for name in MODULES):
        own = {n: one for n, one in vars(module).items() if n[0] != "_"}
        found |= {n: o for n, o in own.items() if getattr(o, "__module__", "") == module.__name__}
    return found


def results(one: object) -> Iterator[tuple[str, object]]:
    """What a function returns; a class's fields, and what its methods and properties return."""
    if inspect.isfunction(unwrapped := inspect.unwrap(one)):
        yield "", unwrapped.__annotations__.get("return")
    if inspect.isclass(one) and one.__module__.startswith("thincam_jax"):
        if dataclasses.is_dataclass(one):
            yield from ((field.name, field.type) for field in dataclasses.fields(one))
        for name, part in vars(one).items():
            part = getattr(part, "__func__", getattr(part, "fget", None) or part)
            part = getattr(part, "func", part)  # of a cached property
            if name[0] != "_" and inspect.isfunction(part):
                yield name, inspect.unwrap(part).__annotations__.get("return")


def test_results_are_records():
    """Dictionaries of whatever would have to be looked up in the source."""
    found = [
        (name, part, str(kind))
        for name, one in faces().items()
        for part, kind in results(one)
        if kind is not None
    ]
    assert len(found) > 1000
    assert not [one for one in found if re.search(r"(dict|Mapping)\[str, (typing\.)?Any\]", one[2])]


def test_seeds_are_taken():
    public = faces()
    keys = {
        name: inspect.signature(one).parameters["key"].annotation
        for name, one in public.items()
        if inspect.isfunction(inspect.unwrap(one)) and "key" in inspect.signature(one).parameters
    }
    assert len(keys) > 12
    assert not {n for n, kind in keys.items() if kind == PRNGKeyArray} - WITHIN


def test_a_seed_is_the_key_of_it():
    drawn = [
        contour_target(key, tc.Grid((24, 20), 4 * um), feature=40 * um, line_width=8 * um)
        for key in (3, jax.random.key(3), 4)
    ]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0], drawn[2])


def assigned(name: str) -> ast.expr:
    """The value of a constant of docs/conf.py."""
    conf = ast.parse((ROOT / "docs/conf.py").read_text("utf-8"))
    (value,) = (
        node.value
        for node in conf.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == name
    )
    return value


@functools.cache
def listed() -> set[str]:
    """The packages and modules of the reference."""
    packages = assigned("PACKAGES")
    assert isinstance(packages, ast.Tuple)
    names = {one.value for one in packages.elts if isinstance(one, ast.Constant)}
    names |= {f"thincam_jax.{one}" for one in ast.literal_eval(assigned("MODULES"))}
    return names | {"thincam_jax", "thincam_jax.units"}


def public(module: str, name: str) -> bool:
    """Whether the reference lists a module, or a sub-package that is imported by its name."""
    return module in listed() or f"{module}.{name}" in listed()


def test_the_reference_names_what_packages_export():
    """By the program of docs/conf.py itself, without what needs Sphinx."""
    path = ROOT / "docs/conf.py"
    conf = ast.parse(path.read_text("utf-8"))
    constants = {"DOCS", "PACKAGE", "TOP", "PACKAGES", "MODULES", "ROOMS"}
    conf.body = [
        node
        for node in conf.body
        if isinstance(node, ast.Import | ast.ImportFrom | ast.FunctionDef)
        or (isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) in constants)
    ]
    program: dict[str, Any] = {"__file__": str(path)}
    exec(compile(conf, path, "exec"), program)
    seen = set()
    pages = {one: program["reference_page"](one, seen) for one in program["PACKAGES"]}
    assert "   PlugAndPlay\n" in pages["thincam_jax"]
    assert "   residual_noise\n" not in "".join(pages.values())
    listed = [
        f"{package}.{name}"
        for package, page in pages.items()
        for name in re.findall(r"^   (\w+)$", page, re.MULTILINE)
    ]
    assert sorted(listed) == sorted(promised(packages=False))
    assert {f"thincam_jax.{name}" for name in program["MODULES"]}.isdisjoint(pages)
    assert "   find_plate\n" in program["modules_page"]()


def promised(packages=True) -> list[str]:
    """The list of docs/api/index.md: names that versions keep, by task."""
    text = (ROOT / "docs/api/index.md").read_text("utf-8").split("by task")[1].split("What they")[0]
    rows = [row for row in text.split("\n- ") if packages or not row.startswith("**Packages**")]
    found = [name for row in rows for name in re.findall(r"`tc\.([\w.]+)`", row)]
    return [f"thincam_jax.{name}" for name in found]


def exported() -> list[str]:
    """What the packages export: `X as X` in their `__init__` files."""
    found = []
    for path in sorted(PACKAGE.rglob("__init__.py*")):
        package = ".".join(path.parent.relative_to(ROOT).parts)
        for node in ast.parse(path.read_text("utf-8")).body:
            if isinstance(node, ast.ImportFrom):
                found += [f"{package}.{one.name}" for one in node.names if one.asname == one.name]
    return found


def test_versions_keep_few_names_and_these():
    """The list of the reference is what the packages export; a new name replaces another."""
    assert sorted(promised()) == sorted(exported())
    assert len(promised()) <= 180
    assert len([name for name in promised() if name.count(".") == 1]) <= 60
    for name in promised():
        assert operator.attrgetter(name.removeprefix("thincam_jax."))(tc) is not None
    rig = (ROOT / "docs/api/index.md").read_text("utf-8").split("functions of `tc.hardware.plans`:")
    plans = {name: one for name, one in vars(tc.hardware.plans).items() if inspect.isfunction(one)}
    made_there = [n for n, one in plans.items() if one.__module__ == tc.hardware.plans.__name__]
    assert re.findall(r"`(\w+)`", rig[1].split("\n\n")[0]) == [n for n in made_there if n[0] != "_"]


USERS = [path.read_text("utf-8") for path in sorted((ROOT / "experiments").glob("*.py"))]


USERS += [
    "\n".join(re.findall(r"```py(?:thon)?\n(.*?)```", page, re.DOTALL)) for page in pages().values()
]


def test_scripts_and_pages_need_public_modules_only():
    """What they import, and in the pages' text what is named with its module."""
    internal = {
        f"{node.module}.{alias.name}"
        for text in USERS
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
        if node.module.startswith("thincam_jax") and not public(node.module, alias.name)
    }
    named = re.findall(r"`(thincam_jax(?:\.\w+)*)\.(\w+)[(`]", "\n".join(pages().values()))
    internal |= {f"{module}.{name}" for module, name in named if not public(module, name)}
    assert not internal
