"""The rules of the package's structure, checked by reading its source.

Each rule is a function from the parsed modules to a list of complaints. It is applied to the
package and, below, to small packages that break it: a rule that has gone blind is noticed.
"""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from helpers import ROOT

PACKAGE = "thincam_jax"

# A module imports only from the modules to its left, or from its own package. `waveguide` stands
# where it may use everything up to the capture. A new module goes where its imports allow.
ORDER = (
    *(
        "units",
        "_checks",
        "_files",
        "_memory",
        "_phase",
        "_precision",
        "grids",
        "chirp",
        "targets",
        "scene",
        "masks",
    ),
    *(
        "sensor",
        "propagation",
        "camera",
        "cost",
        "digits",
        "psf",
        "selection",
        "responses",
        "operators",
        "imaging",
        "planning",
        "capture",
        "waveguide",
        "reconstruct",
    ),
    *("metrics", "depth", "design", "calibrate", "measured"),
    *(
        "config_file",
        "config",
        "config_refocus",
        "config_pareto",
        "config_training",
        "config_design",
    ),
    *("study", "design_run", "report"),
    *("bench", "doctor", "run", "run_refocus", "run_design", "reconstruction_run", "sweep"),
    *("terminal", "cli_reconstruct", "cli_refocus", "cli_sweep", "cli_design", "cli"),
    "hardware",
)
ENTRY = ("__init__", "__main__")  # they stand right of everything but `hardware`
MAX_LINES = 500

JAXOPT_FILES = ("reconstruct/_jaxopt.py", "design/_jaxopt.py")
FRONT_END_LIBRARIES = ("matplotlib", "pydantic", "typer", "rich", "jinja2")
FRONT_END = (
    *("config", "config_refocus", "config_pareto", "config_training", "config_design"),
    *("study", "report", "bench", "doctor"),
    *("terminal", "cli_reconstruct", "cli_refocus", "cli_sweep", "cli_design", "cli"),
)


@dataclass(frozen=True)
class Module:
    """One source file: its path inside the package, its text and its syntax tree."""

    path: str  # "propagation/select.py"
    text: str
    tree: ast.Module

    @property
    def top(self) -> str:
        """The top-level module it belongs to: "propagation"."""
        return Path(self.path).parts[0].removesuffix(".py")

    @property
    def package(self) -> list[str]:
        """The package that relative imports start from: ["thincam_jax", "propagation"]."""
        return [PACKAGE, *Path(self.path).parts[:-1]]

    @property
    def is_public(self) -> bool:
        names = Path(self.path).with_suffix("").parts
        return all(name in ENTRY or not name.startswith("_") for name in names)

    def imports(self) -> Iterator[tuple[int, str]]:
        """Line and absolute dotted name of each import, wherever in the file it stands.

        `from a import b` counts as `a.b`, whether b is a module or a name in one.
        """
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Import):
                for alias in node.names:
                    yield node.lineno, alias.name
            elif isinstance(node, ast.ImportFrom):
                base = self.package[: len(self.package) - node.level + 1] if node.level else []
                base = [*base, node.module] if node.module else base
                for alias in node.names:
                    yield node.lineno, ".".join([*base, alias.name])


def read_package(folder: Path) -> list[Module]:
    modules = []
    for path in sorted(folder.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        name = path.relative_to(folder).as_posix()
        modules.append(Module(name, text, ast.parse(text, str(path))))
    return modules


def unknown_modules(modules: list[Module]) -> list[str]:
    return [
        f"{module.path}: the top-level module {module.top!r} has no place in the import order: "
        "add it to ORDER in tests/test_architecture.py, right of all that it imports"
        for module in modules
        if module.top not in (*ORDER, *ENTRY)
    ]


def imports_against_the_order(modules: list[Module]) -> list[str]:
    unknown = {module.top for module in modules} - {*ORDER, *ENTRY}  # told by the rule above
    complaints = []
    for module in modules:
        for line, name in module.imports():
            parts = name.split(".")
            if parts[0] != PACKAGE:
                continue
            where = f"{module.path}:{line}"
            target = parts[1] if len(parts) > 1 else None
            if target == "hardware" and module.top != "hardware":
                complaints.append(f"{where}: imports hardware, which nothing may import")
            elif module.top in ENTRY or target in (module.top, *unknown):
                continue
            elif target not in ORDER:
                complaints.append(
                    f"{where}: imports {name} from the top of the package, which imports "
                    "everything: import it from the module that defines it"
                )
            elif module.top in ORDER and ORDER.index(target) > ORDER.index(module.top):
                complaints.append(
                    f"{where}: {module.top} imports {target}, which stands right of it in ORDER"
                )
    return complaints


def jaxopt_outside_its_files(modules: list[Module]) -> list[str]:
    return [
        f"{module.path}:{line}: imports jaxopt; only {' and '.join(JAXOPT_FILES)} may"
        for module in modules
        for line, name in module.imports()
        if name.split(".")[0] == "jaxopt" and module.path not in JAXOPT_FILES
    ]


def front_end_libraries_in_the_core(modules: list[Module]) -> list[str]:
    return [
        f"{module.path}:{line}: imports {name.split('.')[0]}; only {', '.join(FRONT_END)} may"
        for module in modules
        for line, name in module.imports()
        if name.split(".")[0] in FRONT_END_LIBRARIES and module.top not in FRONT_END
    ]


def star_imports(modules: list[Module]) -> list[str]:
    return [
        f"{module.path}:{line}: star import: name what is imported"
        for module in modules
        for line, name in module.imports()
        if name.split(".")[-1] == "*"
    ]


def long_modules(modules: list[Module]) -> list[str]:
    counts = [(module.path, len(module.text.splitlines())) for module in modules]
    return [
        f"{path}: {lines} lines, {MAX_LINES} allowed: split it"
        for path, lines in counts
        if lines > MAX_LINES
    ]


def missing_docstrings(modules: list[Module]) -> list[str]:
    return [
        f"{module.path}: a public module begins with a docstring"
        for module in modules
        if module.is_public and not (ast.get_docstring(module.tree) or "").strip()
    ]


RULES = (
    unknown_modules,
    imports_against_the_order,
    jaxopt_outside_its_files,
    front_end_libraries_in_the_core,
    star_imports,
    long_modules,
    missing_docstrings,
)


@pytest.fixture(scope="module")
def package() -> list[Module]:
    return read_package(ROOT / PACKAGE)


def test_the_package_is_found(package):
    assert "units.py" in [module.path for module in package]


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_package_keeps(rule, package):
    complaints = rule(package)
    assert not complaints, "\n" + "\n".join(complaints)


DOC = '"""What it is."""\n'

# rule, file, source, part of the complaint
BROKEN = [
    (unknown_modules, "extras.py", DOC, "add it to ORDER in tests/test_architecture.py"),
    (unknown_modules, "extras/deep.py", DOC, "'extras' has no place"),
    (imports_against_the_order, "grids.py", "import thincam_jax.psf", "grids imports psf"),
    (imports_against_the_order, "grids.py", "from thincam_jax.psf import psf", "grids imports psf"),
    (imports_against_the_order, "grids.py", "from thincam_jax import psf", "grids imports psf"),
    (imports_against_the_order, "grids.py", "from .psf import psf", "grids imports psf"),
    (imports_against_the_order, "grids.py", "from . import psf", "grids imports psf"),
    (imports_against_the_order, "masks/fza.py", "from ..camera import x", "masks imports camera"),
    (imports_against_the_order, "masks/__init__.py", "from .. import psf", "masks imports psf"),
    (imports_against_the_order, "grids.py", "def f():\n    from .psf import psf", "grids.py:2: "),
    (imports_against_the_order, "waveguide/trace.py", "from ..reconstruct import x", "right of it"),
    (imports_against_the_order, "psf.py", "import thincam_jax as tc", "from the top"),
    (imports_against_the_order, "psf.py", "from . import Sensor", "from the top"),
    (imports_against_the_order, "cli.py", "from .hardware import x", "nothing may import"),
    (imports_against_the_order, "__init__.py", "from . import hardware", "nothing may import"),
    (jaxopt_outside_its_files, "reconstruct/tv.py", "import jaxopt", "only reconstruct/_jaxopt.py"),
    (jaxopt_outside_its_files, "_jaxopt.py", "from jaxopt.projection import x", "imports jaxopt"),
    (front_end_libraries_in_the_core, "psf.py", "import matplotlib.pyplot as plt", "matplotlib"),
    (front_end_libraries_in_the_core, "scene.py", "from pydantic import BaseModel", "pydantic"),
    (front_end_libraries_in_the_core, "hardware/stage.py", "import typer", "typer"),
    (front_end_libraries_in_the_core, "__init__.py", "import rich, jinja2", "jinja2"),
    (star_imports, "psf.py", "from .camera import *", "star import"),
    (star_imports, "psf.py", "from numpy import *", "star import"),
    (long_modules, "psf.py", DOC + "x = 1\n" * MAX_LINES, "501 lines, 500 allowed"),
    (missing_docstrings, "psf.py", "x = 1", "begins with a docstring"),
    (missing_docstrings, "masks/__init__.py", "", "begins with a docstring"),
]

SOUND = [
    ("units.py", DOC + "import math"),
    ("_memory.py", "x = 1"),
    ("masks/_pattern.py", "x = 1"),
    ("masks/__init__.py", DOC + "from .fza import Plate as Plate"),
    ("masks/fza.py", DOC + "from .. import grids\nfrom ..units import mm\nfrom . import _pattern"),
    ("waveguide/trace.py", DOC + "from ..capture import x"),
    ("reconstruct/_jaxopt.py", "import jaxopt"),
    ("report.py", DOC + "import matplotlib.pyplot, jinja2\nfrom .waveguide import x"),
    ("hardware/stage.py", DOC + "from thincam_jax.cli import x\nfrom .bus import y"),
    ("__init__.py", DOC + "from .psf import psf as psf\nfrom . import cli"),
    ("__main__.py", DOC + "from .cli import main"),
    ("psf.py", DOC + "import rich_text, jaxoptics\n" + "x = 1\n" * (MAX_LINES - 2)),
]


def write_package(folder: Path, files: list[tuple[str, str]]) -> list[Module]:
    for path, source in files:
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(source, encoding="utf-8")
    return read_package(folder)


@pytest.mark.parametrize(("rule", "path", "source", "complaint"), BROKEN)
def test_rule_sees_what_breaks_it(rule, path, source, complaint, tmp_path):
    modules = write_package(tmp_path, [*SOUND, (path, source)])
    complaints = [text for text in rule(modules) if text.startswith(path)]
    assert complaints
    assert complaint in "\n".join(complaints)


def test_rules_pass_a_sound_package(tmp_path):
    modules = write_package(tmp_path, SOUND)
    assert [text for rule in RULES for text in rule(modules)] == []
