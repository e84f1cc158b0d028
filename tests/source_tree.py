"""The package's source as syntax trees, and small packages to try a rule of the source on."""

import ast
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

PACKAGE = "thincam_jax"
ENTRY = ("__init__", "__main__")  # they stand above all rooms but the one outside
DOC = '"""Example of a module."""\n'
MAX_LINES, MOST_PARAMETERS = 500, 6

_SEVEN = [f"{name}: int" for name in "abcdefg"]
FIELDS, TAKEN = "\n".join(f"    {field}" for field in _SEVEN), ", ".join(_SEVEN)

# Files that break no rule.
SOUND = [
    ("units.py", DOC + "import math\n\n\n@dataclass(frozen=True)\nclass A:\n    x: int"),
    ("_core/memory.py", "x = Path('/proc/meminfo').read_text()"),
    ("design/prose.py", '"""At most one, of `a`: of all; as `b`.\\n\\n- `c`: weight, as given."""'),
    ("_core/grids.py", DOC + "from ..units import mm"),
    ("lensless/masks/_pattern.py", "x = 1"),
    ("lensless/masks/__init__.py", DOC + "from .fza import Plate as Plate"),
    ("lensless/masks/fza.py", DOC + "from ..._core import grids\nfrom . import _pattern"),
    ("design/adam.py", DOC + "class B(optimistix.B):\n    def step(self, x): ..."),
    ("design/space.py", DOC + "class C:\n    def f(self, x: int):\n        def g(y): ..."),
    ("waveguide/rays.py", DOC + f"class D:\n{FIELDS}\n    def __init__(self, {TAKEN}): ..."),
    ("waveguide/hologram.py", DOC + f"class E:\n    def f(self, {TAKEN.partition(', ')[2]}): ..."),
    ("lensless/psf.py", DOC + "import rich_text, jaxoptics\n" + "x = 1\n" * (MAX_LINES - 2)),
    ("reconstruction/implicit_gradient.py", DOC + "import jaxopt"),
    ("plot/curves.py", DOC + "import matplotlib.figure"),
    ("plot/high.py", DOC + "from ..studies.result import x"),
    ("design/landscape.py", DOC + "def plot():\n    from ..plot import curves"),
    ("design/curve.py", DOC + "if TYPE_CHECKING:\n    from matplotlib.axes import Axes"),
    ("commands/figures.py", DOC + "import matplotlib.pyplot, jinja2\nfrom ..studies import x"),
    ("commands/sections.py", DOC + "def f():\n    from ..learn.tau import x"),
    ("hardware/commands/run.py", DOC + "import rich\nfrom .. import base"),
    ("hardware/studies/rig.py", DOC + "def f():\n    from ...waveguide.rays import x"),
    ("learn/plot.py", DOC + "from matplotlib.figure import Figure\nfrom ..plot import curves"),
    ("measured/__init__.pyi", DOC + "from ..waveguide.measured.fit import x as x"),
    ("studies/result.py", DOC + "if TYPE_CHECKING:\n    from matplotlib.figure import Figure\n"),
    ("commands/rig/command.py", DOC + "def run():\n    from ...hardware import stage"),
    ("hardware/stage.py", DOC + "from thincam_jax.measured.read import x\nfrom .bus import y"),
    ("__init__.py", DOC + "from .lensless.psf import psf as psf\nfrom . import commands"),
    ("__main__.py", DOC + "from .commands.cli import main"),
]


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

    @cached_property
    def nodes(self) -> tuple[ast.AST, ...]:
        """All of the syntax tree, in the order of `ast.walk`."""
        return tuple(ast.walk(self.tree))

    @cached_property
    def blocks(self) -> list[ast.FunctionDef | ast.If]:
        """Functions, and the blocks that only a type checker runs."""
        return [
            node
            for node in self.nodes
            if isinstance(node, ast.FunctionDef)
            or (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
        ]

    @cached_property
    def imports(self) -> list[tuple[int, str]]:
        """Line and absolute dotted name of each import, wherever in the file it stands.

        `from a import b` counts as `a.b`, whether b is a module or a name in one.
        """
        return list(self._imports(()))

    @cached_property
    def imports_at_run_time(self) -> list[tuple[int, str]]:
        """Those that are not for annotations only, under `if TYPE_CHECKING`."""
        guards = [block for block in self.blocks if isinstance(block, ast.If)]
        return list(self._imports({node for guard in guards for node in guard.body}))

    def _imports(self, left_out: Collection[ast.AST]) -> Iterator[tuple[int, str]]:
        for node in self.nodes:
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


@cache
def read_package(folder: Path) -> list[Module]:
    modules = []
    for path in sorted(folder.rglob("*.py*")):
        if path.suffix not in (".py", ".pyi"):  # a stub holds the names of a lazy package
            continue
        text = path.read_text(encoding="utf-8")
        name = path.relative_to(folder).as_posix()
        modules.append(Module(name, text, ast.parse(text, str(path))))
    return modules


def read_scripts(root: Path) -> list[Module]:
    paths = [path for folder in ("docs", "experiments") for path in (root / folder).glob("*.py")]
    texts = [(path.relative_to(root).as_posix(), path.read_text("utf-8")) for path in paths]
    return [Module(name, text, ast.parse(text)) for name, text in texts]


def write_package(folder: Path, files: list[tuple[str, str]]) -> list[Module]:
    for path, source in files:
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(source, encoding="utf-8")
    return read_package(folder)
