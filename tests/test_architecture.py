"""The order of the package's rooms and the style of its source, checked by reading it.

Each rule is a function from the parsed modules to a list of complaints. It is applied to the
package and, below, to small packages that break it: a rule that has gone blind is noticed.
"""

from collections.abc import Sequence
from pathlib import Path

import pytest
from source_style import BROKEN_STYLE, MANY_PARAMETERS, STYLE_RULES, long_signatures
from source_tree import (
    DOC,
    ENTRY,
    PACKAGE,
    SOUND,
    Module,
    read_package,
    read_scripts,
    write_package,
)

from helpers import ROOT

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
# The rig stands outside: it may use what captures need, and only commands know of it.
OUTSIDE, OUTSIDE_USES = "hardware", "measured"
# Rooms that can be left out with all that is theirs: `waveguide/studies/` stands on the floor of
# `studies`, `hardware/commands/` on that of `commands`, and nobody else waits for them.
CLOSED = ("hardware", "waveguide", "learn")
ROOMS = (*(room for floor in FLOORS for room in floor), OUTSIDE)
FLOOR = {room: height for height, floor in enumerate(FLOORS) for room in floor}
MOST_ENTRIES = 14

JAXOPT_FILES = ("reconstruction/implicit_gradient.py", "design/_jaxopt.py")
FRONT_END_LIBRARIES = ("matplotlib", "pydantic", "typer", "rich", "jinja2")
PLOT = "plot"  # draws with matplotlib; a method that draws imports the file that draws it
FRONT_END = "commands"
ARRAY_LIBRARIES = ("jax", "jaxlib", "jaxtyping")


def room_of(parts: Sequence[str]) -> str:
    """Room on whose floor a file stands: `plot` for ("learn", "plot"), `learn` for ("learn",)."""
    inner = parts[1] if parts[0] in CLOSED and len(parts) > 1 else ""
    return inner if inner in FLOOR else parts[0]


def room(module: Module) -> str:
    """`room_of` of a file."""
    return room_of(Path(module.path).with_suffix("").parts)


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
    complaints, drawing = [], floors_of_figures(modules)
    for module in modules:
        own = room(module)
        for line, name in module.imports:
            parts = name.split(".")
            if parts[0] != PACKAGE or (module.top not in (*ROOMS, *ENTRY)):
                continue  # a room without a floor is told by the rule above
            where = f"{module.path}:{line}"
            target = room_of(parts[1:]) if len(parts) > 1 else None
            if target == own:
                continue
            if target == OUTSIDE:
                lazy = module.path == "__init__.pyi" and parts[2:] == []
                command = own == FRONT_END and (module.top == OUTSIDE or waits(module, line))
                if not lazy and not command and module.top != OUTSIDE:
                    complaints.append(
                        f"{where}: imports {OUTSIDE}, which only a command may, inside a function"
                    )
            elif target not in FLOOR:
                complaints.append(
                    f"{where}: imports {name} from the top of the package, which imports "
                    "everything: import it from the module that defines it"
                )
            elif own == OUTSIDE and FLOOR[target] > FLOOR[OUTSIDE_USES]:
                complaints.append(f"{where}: {OUTSIDE} imports {target}, above {OUTSIDE_USES}")
            elif own in FLOOR and FLOOR[target] >= FLOOR[own]:
                height = drawing.get(".".join(parts[:3]), FLOOR[target])
                figure = waits(module, line) and height <= FLOOR[own]
                if {own, target} != {"units", "_core"} and not figure:
                    complaints.append(f"{where}: {own} imports {target}, which is no lower")
    return complaints


def imports_across_borders(modules: list[Module]) -> list[str]:
    """What belongs to a closed room is imported by others when they are asked for it: inside a
    function, for annotations only, or by a face that is lazy."""
    return [
        f"{module.path}:{line}: imports {name}, which may have been left out: import it inside the "
        "function that needs it"
        for module in modules
        for line, name in module.imports_at_run_time
        if name.split(".")[0] == PACKAGE
        and (owner := [*name.split("."), ""][1]) in CLOSED
        and owner != module.top
        and Path(module.path).name != "__init__.pyi"
        and not waits(module, line)
    ]


def floors_of_figures(modules: list[Module]) -> dict[str, int]:
    """Floor of each file of `plot`: that of the highest room that it imports when it runs.

    So what it draws may stand below the room, and import the file where it is asked for a figure.
    """
    paths = {m: (PACKAGE, *Path(m.path).with_suffix("").parts) for m in modules if room(m) == PLOT}
    files = {".".join(path[:3]): module for module, path in paths.items()}

    def height(name: str, above: tuple[str, ...] = ()) -> int:
        imported = [one.split(".") for _, one in files[name].imports_at_run_time]
        inside = [parts[1:] for parts in imported if parts[0] == PACKAGE and parts[1:]]
        rooms = [FLOOR.get(room_of(parts), 0) for parts in inside]
        figures = {".".join(parts[:3]) for parts in imported} & files.keys() - {*above, name}
        rooms = [room for room in rooms if room != FLOOR[PLOT]]
        return max([0, *rooms, *(height(one, (*above, name)) for one in figures)])

    return {name: height(name) for name in files}


def circles_through_figures(modules: list[Module]) -> list[str]:
    """A file of `plot` does not import, by others or lazily, what imports it to be drawn."""
    files = {
        f"{PACKAGE}.{Path(m.path).with_suffix('').as_posix()}".replace("/", "."): m for m in modules
    }
    uses = {
        name: {
            found
            for _, one in module.imports_at_run_time
            if (found := one if one in files else one.rpartition(".")[0]) in files
        }
        for name, module in files.items()
    }

    def reaches(start: str) -> set[str]:
        found, new = set(), {start}
        while new:
            new = {other for one in new for other in uses[one]} - found
            found |= new
        return found

    return [
        f"{module.path}: draws what it imports itself: import that for annotations only"
        for name, module in files.items()
        if room(module) == PLOT and name in reaches(name)
    ]


def modules_hidden_by_names(modules: list[Module]) -> list[str]:
    """`package.name` is a module or what a package's face imports by that name, never both."""
    paths = {Path(module.path).with_suffix("").as_posix() for module in modules}
    paths |= {Path(module.path).parent.as_posix() for module in modules}
    return [
        f"{module.path}:{line}: {name.split('.')[-1]} hides the module of that name"
        for module in modules
        if Path(module.path).stem == "__init__"
        for line, name in module.imports
        if (Path(module.path).parent / name.split(".")[-1]).as_posix() in paths
        and name != ".".join([*module.package, name.split(".")[-1]])
    ]


def jaxopt_outside_its_files(modules: list[Module]) -> list[str]:
    return [
        f"{module.path}:{line}: imports jaxopt; only {' and '.join(JAXOPT_FILES)} may"
        for module in modules
        for line, name in module.imports
        if name.split(".")[0] == "jaxopt" and module.path not in JAXOPT_FILES
    ]


def front_end_libraries_in_the_core(modules: list[Module]) -> list[str]:
    """A result may draw itself: matplotlib is then imported in the function, or for types only."""
    return [
        f"{module.path}:{line}: imports {name.split('.')[0]}; only {FRONT_END} may"
        for module in modules
        for line, name in module.imports_at_run_time
        if name.split(".")[0] in FRONT_END_LIBRARIES
        and room(module) != FRONT_END
        and (room(module), name.split(".")[0]) != (PLOT, "matplotlib")
    ]


def arrays_in_commands(modules: list[Module]) -> list[str]:
    """Commands read, run, write and print; what computes with arrays is library."""
    return [
        f"{module.path}:{line}: imports {name.split('.')[0]}; move what computes into the library"
        for module in modules
        for line, name in module.imports
        if name.split(".")[0] in ARRAY_LIBRARIES and room(module) == FRONT_END
    ]


def waits(module: Module, line: int) -> bool:
    """Whether an import waits for a function's call, or is the type checker's alone."""
    return any(block.lineno < line <= (block.end_lineno or block.lineno) for block in module.blocks)


RULES = (
    unknown_rooms,
    crowded_roots,
    imports_against_the_floors,
    imports_across_borders,
    circles_through_figures,
    modules_hidden_by_names,
    jaxopt_outside_its_files,
    front_end_libraries_in_the_core,
    arrays_in_commands,
    *STYLE_RULES,
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


def test_functions_with_many_parameters_are_listed_exactly(package):
    """One that has few is taken off the list."""
    listed = {(path, name) for path, names in MANY_PARAMETERS.items() for name in names}
    found = {
        (module.path, function.name)
        for module in package
        for function, _ in long_signatures(module)
    }
    assert listed <= found


def scripts_on_commands(scripts: list[Module]) -> set[str]:
    return {
        script.path
        for script in scripts
        for _, name in script.imports
        if name.startswith(f"{PACKAGE}.{FRONT_END}")
    }


def test_scripts_use_the_library():
    assert not scripts_on_commands(read_scripts(ROOT))


@pytest.mark.parametrize(
    "line", ["from thincam_jax.commands.cli import app", "import thincam_jax.commands"]
)
def test_a_script_on_commands_is_seen(tmp_path, line):
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs/draw.py").write_text(f"import thincam_jax as tc\n{line}\n")
    assert scripts_on_commands(read_scripts(tmp_path)) == {"docs/draw.py"}


# rule, file, source, part of the complaint
UP, BORDER = imports_against_the_floors, imports_across_borders
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
    (UP, "design/space.py", "from ..hardware import x", "only a command may"),
    (UP, "commands/rig/command.py", "from ...hardware import x", "inside a function"),
    (UP, "hardware/studies/rig.py", "from ..commands import x", "studies imports commands"),
    (UP, "learn/commands/run.py", "from ...hardware.base import x", "inside a function"),
    (UP, "waveguide/rays.py", "from .studies import x", "waveguide imports studies"),
    (UP, "waveguide/studies/mask.py", "from ...plot import high", "studies imports plot"),
    (BORDER, "commands/cli.py", "from ..learn.commands.command import x", "left out"),
    (BORDER, "hardware/studies/rig.py", "from thincam_jax import waveguide as wg", "left out"),
    (BORDER, "plot/curves.py", "import thincam_jax.learn.training", "inside the function"),
    (arrays_in_commands, "learn/commands/a.py", "import jax", "learn/commands/a.py:1: imports jax"),
    (UP, "__init__.py", "from . import hardware", "only a command may"),
    (UP, "design/space.py", "from ..plot import curves", "which is no lower"),
    (UP, "design/space.py", "def f():\n    from ..plot import curves, high", "which is no lower"),
    (UP, "plot/curves.py", "from ..commands import page", "which is no lower"),
    (
        circles_through_figures,
        "plot/curves.py",
        "def f():\n    from ..design.landscape import x",
        "plot/curves.py: draws what",
    ),
    (UP, "__init__.pyi", "from .hardware.stage import Stage as Stage", "only a command may"),
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
    (arrays_in_commands, "commands/a.py", "import jax.numpy as jnp", "imports jax; move"),
    (arrays_in_commands, "commands/a/b.py", "def f():\n    import jaxtyping", "a/b.py:2: imports"),
    *BROKEN_STYLE,
]


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
