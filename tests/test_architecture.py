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
from thincam_jax._core.quantity import UNITS

PACKAGE = "thincam_jax"

# A room imports only from the floors below it and from itself, never from a room beside it.
FLOORS = (
    ("units", "_core"),
    ("imaging",),
    ("lensless", "waveguide"),
    ("reconstruction", "measured"),
    ("design",),
    ("studies",),
    ("learn",),
    ("plot",),
    ("commands",),
)
# The rig stands outside: it may use what captures need, and only its command knows of it.
OUTSIDE, OUTSIDE_USES = "hardware", "measured"
ROOMS = (*(room for floor in FLOORS for room in floor), OUTSIDE)
FLOOR = {room: height for height, floor in enumerate(FLOORS) for room in floor}
ENTRY = ("__init__", "__main__")  # they stand above all rooms but the one outside
MOST_ENTRIES = 14
MAX_LINES = 500

JAXOPT_FILES = ("reconstruction/implicit_gradient.py", "design/_jaxopt.py")
FRONT_END_LIBRARIES = ("matplotlib", "pydantic", "typer", "rich", "jinja2")
PLOT = "plot"  # draws with matplotlib; what has a `plot` method imports it in that method
FRONT_END = "commands"
# They read what is the package's own, and what the system says of itself.
READ_OWN = (
    *("_core/memory.py", "commands/report.py", "commands/examples.py"),
    "hardware/virtual/",
    *("hardware/cameras/usb3_vision/link.py", "hardware/stages/serial_link.py"),
)


@dataclass(frozen=True)
class Module:
    """One source file: its path inside the package, its text and its syntax tree."""

    path: str  # "lensless/psf.py"
    text: str
    tree: ast.Module

    @property
    def top(self) -> str:
        """The room it belongs to: "lensless"."""
        return Path(Path(self.path).parts[0]).stem

    @property
    def package(self) -> list[str]:
        """The package that relative imports start from: ["thincam_jax", "lensless"]."""
        return [PACKAGE, *Path(self.path).parts[:-1]]

    @property
    def is_public(self) -> bool:
        names = Path(self.path).with_suffix("").parts
        return all(name in ENTRY or not name.startswith("_") for name in names)

    def imports(self, *, at_run_time: bool = False) -> Iterator[tuple[int, str]]:
        """Line and absolute dotted name of each import, wherever in the file it stands.

        `from a import b` counts as `a.b`, whether b is a module or a name in one. `at_run_time`:
        without those for annotations, under `if TYPE_CHECKING`.
        """
        guards = [
            n
            for n in ast.walk(self.tree)
            if isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING"
        ]
        left_out = {n for guard in guards for n in guard.body} if at_run_time else set()
        for node in ast.walk(self.tree):
            if node in left_out:
                continue
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
    for path in sorted(folder.rglob("*.py*")):
        if path.suffix not in (".py", ".pyi"):  # a stub holds the names of a lazy package
            continue
        text = path.read_text(encoding="utf-8")
        name = path.relative_to(folder).as_posix()
        modules.append(Module(name, text, ast.parse(text, str(path))))
    return modules


def unknown_rooms(modules: list[Module]) -> list[str]:
    return [
        f"{module.path}: the room {module.top!r} has no floor: "
        "give it one in FLOORS of tests/test_architecture.py, above all that it imports"
        for module in modules
        if module.top not in (*ROOMS, *ENTRY)
    ]


def crowded_roots(modules: list[Module]) -> list[str]:
    entries = {module.top for module in modules}
    if len(entries) <= MOST_ENTRIES:
        return []
    return [f"{min(entries)}: the root has {len(entries)} entries, {MOST_ENTRIES} allowed"]


def imports_against_the_floors(modules: list[Module]) -> list[str]:
    complaints = []
    for module in modules:
        for line, name in module.imports():
            parts = name.split(".")
            if parts[0] != PACKAGE:
                continue
            where = f"{module.path}:{line}"
            target = parts[1] if len(parts) > 1 else None
            if target == module.top or module.top not in (*ROOMS, *ENTRY):
                continue  # a room without a floor is told by the rule above
            if target == OUTSIDE:
                lazy = module.path == "__init__.pyi" and parts[2:] == []
                if not lazy and not may_use_the_rig(module, line):
                    complaints.append(
                        f"{where}: imports {OUTSIDE}, which only its command may, inside a function"
                    )
            elif target not in FLOOR:
                complaints.append(
                    f"{where}: imports {name} from the top of the package, which imports "
                    "everything: import it from the module that defines it"
                )
            elif module.top == OUTSIDE and FLOOR[target] > FLOOR[OUTSIDE_USES]:
                complaints.append(f"{where}: {OUTSIDE} imports {target}, above {OUTSIDE_USES}")
            elif module.top in FLOOR and FLOOR[target] >= FLOOR[module.top]:
                if {module.top, target} != {"units", "_core"}:
                    if target != PLOT or not waits(module, line):
                        complaints.append(
                            f"{where}: {module.top} imports {target}, which is no lower"
                        )
    return complaints


def may_use_the_rig(module: Module, line: int) -> bool:
    """A command's file may, where the import waits for the command to be called."""
    is_command = module.top == FRONT_END and Path(module.path).name == "command.py"
    return is_command and waits(module, line)


def modules_hidden_by_names(modules: list[Module]) -> list[str]:
    """`package.name` is a module or what a package's face imports by that name, never both."""
    paths = {Path(module.path).with_suffix("").as_posix() for module in modules}
    paths |= {Path(module.path).parent.as_posix() for module in modules}
    return [
        f"{module.path}:{line}: {name.split('.')[-1]} hides the module of that name"
        for module in modules
        if Path(module.path).stem == "__init__"
        for line, name in module.imports()
        if (Path(module.path).parent / name.split(".")[-1]).as_posix() in paths
        and name != ".".join([*module.package, name.split(".")[-1]])
    ]


def jaxopt_outside_its_files(modules: list[Module]) -> list[str]:
    return [
        f"{module.path}:{line}: imports jaxopt; only {' and '.join(JAXOPT_FILES)} may"
        for module in modules
        for line, name in module.imports()
        if name.split(".")[0] == "jaxopt" and module.path not in JAXOPT_FILES
    ]


def front_end_libraries_in_the_core(modules: list[Module]) -> list[str]:
    """A result may draw itself: matplotlib is then imported in the function, or for types only."""
    return [
        f"{module.path}:{line}: imports {name.split('.')[0]}; only {FRONT_END} may"
        for module in modules
        for line, name in module.imports(at_run_time=True)
        if name.split(".")[0] in FRONT_END_LIBRARIES
        and module.top != FRONT_END
        and (module.top, name.split(".")[0]) != (PLOT, "matplotlib")
    ]


def waits(module: Module, line: int) -> bool:
    """Whether an import waits for a function's call, or is the type checker's alone."""
    blocks = (n for n in ast.walk(module.tree) if isinstance(n, (ast.FunctionDef, ast.If)))
    return any(
        block.lineno < line <= (block.end_lineno or block.lineno)
        for block in blocks
        if isinstance(block, ast.FunctionDef) or ast.unparse(block.test) == "TYPE_CHECKING"
    )


def bare_files(modules: list[Module]) -> list[str]:
    """A device in place of a file is read for ever; of a full disk only the system's words say."""
    use = {"read": "read_regular", "write": "write_whole"}
    bare = {f"{what}_{kind}": name for what, name in use.items() for kind in ("bytes", "text")}
    return [
        f"{module.path}:{node.lineno}: {node.attr}: use {bare[node.attr]} of _core/files.py"
        for module in modules
        if not module.path.startswith(READ_OWN)
        for node in ast.walk(module.tree)
        if isinstance(node, ast.Attribute) and node.attr in bare
    ]


def tables_of_units(modules: list[Module]) -> list[str]:
    """A unit stands at its field; labels and readers ask the field's quantity for it."""
    units = {*UNITS, *(unit.replace("^2", "²") for unit in UNITS)}

    def is_unit(value: ast.AST) -> bool:
        inside = value.elts if isinstance(value, ast.Tuple) else [value]
        texts = [str(n.value) for n in inside if isinstance(n, ast.Constant)]
        return any(text in units or text.rpartition(", ")[2] in units for text in texts)

    def is_table(node: ast.AST) -> bool:
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            return node.func.attr == "fromkeys" and any(map(is_unit, node.args))
        return isinstance(node, ast.Dict) and sum(map(is_unit, node.values)) > 1

    return [
        f"{module.path}:{node.lineno}: a table of units: ask the fields for their quantities"
        for module in modules
        for node in ast.walk(module.tree)
        if isinstance(node, ast.Dict | ast.Call) and is_table(node)
    ]


def named_tuples(modules: list[Module]) -> list[str]:
    """A record is a module or a frozen dataclass; a tuple could be unpacked, indexed and added."""
    return [
        f"{module.path}:{node.lineno}: a named tuple: make it an equinox.Module where JAX sees it, "
        "a frozen dataclass elsewhere"
        for module in modules
        for node in ast.walk(module.tree)
        if getattr(node, "id", getattr(node, "attr", "")) in ("NamedTuple", "namedtuple")
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


def missing_annotations(modules: list[Module]) -> list[str]:
    """But of what optimistix names and annotates: the methods of its solvers, except `__init__`."""
    return [
        f"{module.path}:{function.lineno}: {function.name}: annotate {', '.join(bare)}"
        for module in modules
        for function, bare in bare_parameters(module.tree)
        if bare
    ]


def bare_parameters(
    scope: ast.Module | ast.ClassDef,
) -> Iterator[tuple[ast.FunctionDef, list[str]]]:
    """The public functions and methods, and their parameters that say not what they take."""
    of_solver = any(
        ast.unparse(base).startswith("optimistix.") for base in getattr(scope, "bases", ())
    )
    for node in scope.body:
        dunder = getattr(node, "name", "").startswith("__")
        if not dunder and getattr(node, "name", "_").startswith("_"):
            continue
        if isinstance(node, ast.ClassDef):
            yield from bare_parameters(node)
        elif isinstance(node, ast.FunctionDef) and (dunder or not of_solver):
            given = node.args
            every = [*given.posonlyargs, *given.args, given.vararg, *given.kwonlyargs, given.kwarg]
            static = any(ast.unparse(d) == "staticmethod" for d in node.decorator_list)
            own = isinstance(scope, ast.ClassDef) and not static  # `self`, `cls`
            bare = [a.arg for a in every[own:] if a is not None and a.annotation is None]
            yield node, bare


RULES = (
    unknown_rooms,
    crowded_roots,
    imports_against_the_floors,
    modules_hidden_by_names,
    jaxopt_outside_its_files,
    front_end_libraries_in_the_core,
    bare_files,
    tables_of_units,
    named_tuples,
    star_imports,
    long_modules,
    missing_docstrings,
    missing_annotations,
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


# Scripts of users and of the docs that still need a command's parts. Shorter is better.
SCRIPTS_ON_COMMANDS = {
    *("docs/compare_learned.py", "docs/draw_pages.py", "docs/score_refocusing.py"),
    *("docs/ship_network.py", "docs/thesis_refocusing.py"),
    "experiments/simulated_rig.py",
}


def scripts_on_commands(scripts: list[Module]) -> set[str]:
    return {
        script.path
        for script in scripts
        for _, name in script.imports()
        if name.startswith(f"{PACKAGE}.{FRONT_END}")
    }


def read_scripts(root: Path) -> list[Module]:
    paths = [path for folder in ("docs", "experiments") for path in (root / folder).glob("*.py")]
    texts = [(path.relative_to(root).as_posix(), path.read_text("utf-8")) for path in paths]
    return [Module(name, text, ast.parse(text)) for name, text in texts]


def test_scripts_use_the_library():
    """The list says exactly which do not: one that does is taken off it."""
    assert scripts_on_commands(read_scripts(ROOT)) == SCRIPTS_ON_COMMANDS


@pytest.mark.parametrize(
    "line", ["from thincam_jax.commands.cli import app", "import thincam_jax.commands"]
)
def test_a_script_on_commands_is_seen(tmp_path, line):
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs/draw.py").write_text(f"import thincam_jax as tc\n{line}\n")
    assert scripts_on_commands(read_scripts(tmp_path)) == {"docs/draw.py"}


DOC = '"""What it is."""\n'

# rule, file, source, part of the complaint
UP = imports_against_the_floors
BROKEN = [
    (unknown_rooms, "extras.py", DOC, "'extras' has no floor"),
    (unknown_rooms, "extras/deep.py", DOC, "give it one in FLOORS"),
    (UP, "_core/grids.py", "import thincam_jax.imaging.scene", "_core imports imaging"),
    (UP, "_core/grids.py", "from thincam_jax.lensless.psf import psf", "_core imports lensless"),
    (UP, "_core/grids.py", "from thincam_jax import imaging", "_core imports imaging"),
    (UP, "_core/grids.py", "from ..lensless import psf", "_core imports lensless"),
    (UP, "_core/grids.py", "def f():\n    from ..design import x", "_core/grids.py:2: "),
    (UP, "lensless/psf.py", "from ..waveguide.trace import x", "which is no lower"),
    (UP, "waveguide/trace.py", "from ..lensless.psf import x", "which is no lower"),
    (UP, "measured/files.py", "from ..reconstruction import x", "which is no lower"),
    (UP, "lensless/psf.py", "import thincam_jax as tc", "from the top"),
    (UP, "lensless/psf.py", "from .. import Sensor", "from the top"),
    (UP, "hardware/stage.py", "from ..design import x", "above measured"),
    (UP, "hardware/stage.py", "from ..commands.cli import x", "above measured"),
    (UP, "design/space.py", "from ..hardware import x", "only its command may"),
    (UP, "commands/rig/command.py", "from ...hardware import x", "inside a function"),
    (UP, "commands/cli.py", "def f():\n    from ..hardware import x", "only its command may"),
    (UP, "__init__.py", "from . import hardware", "only its command may"),
    (UP, "design/space.py", "from ..plot import curves", "which is no lower"),
    (UP, "plot/curves.py", "from ..commands import page", "which is no lower"),
    (UP, "__init__.pyi", "from .hardware.stage import Stage as Stage", "only its command may"),
    (modules_hidden_by_names, "lensless/__init__.py", "from .psf import psf", "psf hides the"),
    (modules_hidden_by_names, "lensless/__init__.py", "from ..units import masks", "masks hides"),
    (modules_hidden_by_names, "__init__.pyi", "from .lensless.psf import units", "units hides"),
    (jaxopt_outside_its_files, "reconstruction/tv.py", "import jaxopt", "and design/_jaxopt.py"),
    (jaxopt_outside_its_files, "_jaxopt.py", "from jaxopt.projection import x", "imports jaxopt"),
    (front_end_libraries_in_the_core, "lensless/psf.py", "import matplotlib.pyplot", "matplotlib"),
    (front_end_libraries_in_the_core, "plot/curves.py", "import rich", "imports rich"),
    (front_end_libraries_in_the_core, "design/a.py", "def f():\n    import rich", "rich"),
    (front_end_libraries_in_the_core, "units.py", "from pydantic import BaseModel", "pydantic"),
    (front_end_libraries_in_the_core, "hardware/stage.py", "import typer", "typer"),
    (front_end_libraries_in_the_core, "__init__.py", "import rich, jinja2", "jinja2"),
    (
        front_end_libraries_in_the_core,
        "studies/plot.py",
        "from matplotlib.figure import Figure",
        "studies/plot.py:1: imports matplotlib",
    ),
    (
        front_end_libraries_in_the_core,
        "studies/result.py",
        "def f():\n    import matplotlib",
        "studies/result.py:2: imports matplotlib",
    ),
    (
        front_end_libraries_in_the_core,
        "studies/plot.py",
        "def f():\n    import rich",
        "studies/plot.py:2: imports rich",
    ),
    (bare_files, "measured/read.py", "data = path.read_bytes()", "use read_regular"),
    (bare_files, "_core/files.py", "path.write_text('β')", "use write_whole"),
    (
        tables_of_units,
        "design/space.py",
        "U = {'beta': 'rad/mm^2', 'width': 'mm'}",
        "space.py:1: a",
    ),
    (
        tables_of_units,
        "commands/words.py",
        "L = {'a': (1, 'glass, mm'), 'b': ('s',)}",
        "words.py:1: ",
    ),
    (
        tables_of_units,
        "_core/module.py",
        "U = dict.fromkeys(('cell', 'width'), 'mm')",
        "module.py:1",
    ),
    (named_tuples, "lensless/psf.py", "class A(NamedTuple): ...", "psf.py:1: a named tuple"),
    (named_tuples, "units.py", "A = collections.namedtuple('A', 'x')", "units.py:1: "),
    (star_imports, "lensless/psf.py", "from .camera import *", "star import"),
    (star_imports, "lensless/psf.py", "from numpy import *", "star import"),
    (long_modules, "lensless/psf.py", DOC + "x = 1\n" * MAX_LINES, "501 lines, 500 allowed"),
    (missing_docstrings, "lensless/psf.py", "x = 1", "begins with a docstring"),
    (missing_docstrings, "lensless/masks/__init__.py", "", "begins with a docstring"),
    (
        missing_annotations,
        "lensless/psf.py",
        "def f(x: int, *y, z=1): ...",
        "psf.py:1: f: annotate y, z",
    ),
    (
        missing_annotations,
        "lensless/psf.py",
        "class A:\n    def __call__(self, x): ...",
        "annotate x",
    ),
    (
        missing_annotations,
        "lensless/psf.py",
        "class A:\n    @staticmethod\n    def f(x): ...",
        "f: ",
    ),
]

SOUND = [
    ("units.py", DOC + "import math\n\n\n@dataclass(frozen=True)\nclass A:\n    x: int"),
    ("_core/memory.py", "x = Path('/proc/meminfo').read_text()"),
    ("_core/grids.py", DOC + "from ..units import mm"),
    ("lensless/masks/_pattern.py", "x = 1"),
    ("lensless/masks/__init__.py", DOC + "from .fza import Plate as Plate"),
    ("lensless/masks/fza.py", DOC + "from ..._core import grids\nfrom . import _pattern"),
    ("design/adam.py", DOC + "class A(optimistix.B):\n    def step(self, x): ..."),
    ("design/space.py", DOC + "class A:\n    def f(self, x: int):\n        def g(y): ..."),
    ("lensless/psf.py", DOC + "import rich_text, jaxoptics\n" + "x = 1\n" * (MAX_LINES - 2)),
    ("reconstruction/implicit_gradient.py", DOC + "import jaxopt"),
    ("plot/curves.py", DOC + "import matplotlib.figure"),
    ("design/landscape.py", DOC + "def plot():\n    from ..plot import curves"),
    ("design/curve.py", DOC + "if TYPE_CHECKING:\n    from matplotlib.axes import Axes"),
    ("commands/figures.py", DOC + "import matplotlib.pyplot, jinja2\nfrom ..learn import x"),
    (
        "studies/result.py",
        DOC + "if TYPE_CHECKING:\n    from matplotlib.figure import Figure\n",
    ),
    ("commands/rig/command.py", DOC + "def run():\n    from ...hardware import stage"),
    ("hardware/stage.py", DOC + "from thincam_jax.measured.read import x\nfrom .bus import y"),
    ("__init__.py", DOC + "from .lensless.psf import psf as psf\nfrom . import commands"),
    ("__main__.py", DOC + "from .commands.cli import main"),
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


def test_a_crowded_root_is_seen(tmp_path):
    files = [(f"room_{n}.py", DOC) for n in range(MOST_ENTRIES + 1)]
    assert "15 entries, 14 allowed" in crowded_roots(write_package(tmp_path, files))[0]


def test_rules_pass_a_sound_package(tmp_path):
    modules = write_package(tmp_path, SOUND)
    assert [text for rule in RULES for text in rule(modules)] == []
