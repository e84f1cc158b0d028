"""Rules of the style of the package's source, which tests/test_architecture.py applies."""

import ast
import re
from collections.abc import Iterator

from source_tree import DOC, MAX_LINES, MOST_PARAMETERS, Module

from thincam_jax._core.quantity import UNITS

# They read what is the package's own, and what the system says of itself.
READ_OWN = (
    *("_core/memory.py", "commands/report.py", "commands/kinds.py"),
    "hardware/virtual/",
    "hardware/holder.py",
)


def bare_files(modules: list[Module]) -> list[str]:
    """A device in place of a file is read for ever; of a full disk only the system's words say."""
    use = {"read": "read_regular", "write": "write_whole"}
    bare = {f"{what}_{kind}": name for what, name in use.items() for kind in ("bytes", "text")}
    return [
        f"{module.path}:{node.lineno}: {node.attr}: use {bare[node.attr]} of _core/files.py"
        for module in modules
        if not module.path.startswith(READ_OWN)
        for node in module.nodes
        if isinstance(node, ast.Attribute) and node.attr in bare
    ]


def tables_of_units(modules: list[Module]) -> list[str]:
    """A unit stands at its field; labels and readers ask the field's quantity for it."""
    units = {*UNITS, *(unit.replace("^2", "²") for unit in UNITS)}

    def is_unit(value: ast.AST) -> bool:
        if isinstance(value, ast.Tuple):
            return any(map(is_unit, value.elts))
        if isinstance(value, ast.Call):
            return any(map(is_unit, (*value.args, *(given.value for given in value.keywords))))
        text = str(value.value) if isinstance(value, ast.Constant) else ""
        return text in units or text.rpartition(", ")[2] in units

    def is_table(node: ast.AST) -> bool:
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            return node.func.attr == "fromkeys" and any(map(is_unit, node.args))
        return isinstance(node, ast.Dict) and sum(map(is_unit, node.values)) > 1

    return [
        f"{module.path}:{node.lineno}: a table of units: ask the fields for their quantities"
        for module in modules
        for node in module.nodes
        if module.path != "units.py" and isinstance(node, ast.Dict | ast.Call) and is_table(node)
    ]


def names_of_two_classes(modules: list[Module]) -> list[str]:
    """The name of a class has one meaning in the package; a private one in its file."""
    places: dict[str, str] = {}
    return [
        f"{module.path}:{node.lineno}: {node.name} is a class of {places[node.name]}, too"
        for module in modules
        for node in module.tree.body
        if isinstance(node, ast.ClassDef)
        and not node.name.startswith("_")
        and places.setdefault(node.name, module.path) != module.path
    ]


# All that an assertion may be made of: it is for the type checker, and `python -O` leaves it out.
_ASSERTED = (ast.BoolOp, ast.boolop, ast.Compare, ast.cmpop, ast.Attribute, ast.Name, ast.Load)


def asserted_work(modules: list[Module]) -> list[str]:
    """An assertion looks at what is there: no assignment and no call but isinstance."""

    def works(node: ast.AST) -> bool:
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "isinstance":
            return any(map(works, node.args))
        if isinstance(node, ast.Constant | ast.Tuple):
            return any(map(works, ast.iter_child_nodes(node)))
        return not isinstance(node, _ASSERTED) or any(map(works, ast.iter_child_nodes(node)))

    return [
        f"{module.path}:{node.lineno}: an assertion that does more than look: put it before"
        for module in modules
        for node in module.nodes
        if isinstance(node, ast.Assert) and works(node.test)
    ]


def named_tuples(modules: list[Module]) -> list[str]:
    """A record is a module or a frozen dataclass; a tuple could be unpacked, indexed and added."""
    return [
        f"{module.path}:{node.lineno}: a named tuple: make it an equinox.Module where JAX sees it, "
        "a frozen dataclass elsewhere"
        for module in modules
        for node in module.nodes
        if getattr(node, "id", getattr(node, "attr", "")) in ("NamedTuple", "namedtuple")
    ]


# Functions whose parameters another gives, or that are a record's own numbers.
MANY_PARAMETERS = {
    "_core/quantity.py": ("quantity",),  # the words that declare one field
    "commands/reconstruct/command.py": ("reconstruct", "check"),  # the options of the command
    "commands/evaluate/command.py": ("evaluate",),
    "commands/sweep/command.py": ("sweep",),
    "reconstruction/admm.py": ("init", "postprocess"),  # a solver of optimistix
    "reconstruction/proximal_gradient.py": ("init", "postprocess"),
    # A record; of its sides and `pixel_pitch`, as in files, it holds the number of pixels.
    "lensless/masks/fza.py": ("__init__",),
}


def many_parameters(modules: list[Module]) -> list[str]:
    """A function of more than six lacks a record; a record's constructor takes its fields."""
    return [
        f"{module.path}:{function.lineno}: {function.name} has {len(names)} parameters, "
        f"{MOST_PARAMETERS} allowed: put those that belong together into a record"
        for module in modules
        for function, names in long_signatures(module)
        if function.name not in MANY_PARAMETERS.get(module.path, ())
    ]


def long_signatures(module: Module) -> Iterator[tuple[ast.FunctionDef, list[str]]]:
    """Functions of more than six parameters, `self` apart, but the constructors of records."""
    fields = {
        function: {ast.unparse(n.target) for n in node.body if isinstance(n, ast.AnnAssign)}
        for node in module.nodes
        if isinstance(node, ast.ClassDef)
        for function in node.body
        if getattr(function, "name", "") == "__init__"
    }
    for node in module.nodes:
        if isinstance(node, ast.FunctionDef):
            every = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            names = [a.arg for a in every if a.arg not in ("self", "cls")]
            if len(names) > MOST_PARAMETERS and not fields.get(node, set()).issuperset(names):
                yield node, names


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


_PRODUCTS = {
    *(f"jnp.{name}" for name in ("dot", "einsum", "inner", "matmul", "tensordot", "vdot")),
    *(f"jax.lax.{name}" for name in ("conv_general_dilated", "dot", "dot_general")),
}
_NAMES = {name.rpartition(".")[2] for name in _PRODUCTS}


def rounded_products(modules: list[Module]) -> list[str]:
    """Products without `precision`: GPUs round float32 factors to 10 bits (TF32) by default."""
    return [
        f"{module.path}:{node.lineno}: {ast.unparse(node.func)}: give precision='highest'"
        for module in modules
        for node in module.nodes
        if isinstance(node, ast.Call)
        and getattr(node.func, "attr", "") in _NAMES
        and ast.unparse(node.func) in _PRODUCTS
        and "precision" not in {keyword.arg for keyword in node.keywords}
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


_VAGUE = {r"told\b(?!\s+apart)": "reported, given or found"}


def vague_words(modules: list[Module]) -> list[str]:
    return [
        f"{module.path}: {found[0]}: say what it is: {better}"
        for module in modules
        for word, better in _VAGUE.items()
        for found in re.finditer(rf"\b(?i:{word})\b", module.text)
    ]


_DANGLING = r"(?:Of|As|By|With|Without|From|In|At(?! most)|For|Over|On|Before|What|Which|Those)\b"
_BEGINNING = re.compile(rf"{_DANGLING}|The same\b")
_ITEM = re.compile(r"(?:^|[-;.] )(`[^`]+`(?:, `[^`]+`)*(?: \([^)]*\))?: (?:of|as|the same|what))\b")
# Complaints that files still have: lower a number with each that is mended.


def docstrings(module: Module) -> Iterator[tuple[int, str]]:
    """Line and text of each docstring, in one line."""
    for node in module.nodes:
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            if text := ast.get_docstring(node):
                yield node.body[0].lineno, " ".join(text.split())


def dangling(module: Module) -> list[str]:
    """Docstrings and their items that can only be read with the signature."""
    complaints = []
    for line, text in docstrings(module):
        place = f"{module.path}:{line}"
        if found := _BEGINNING.match(text):
            complaints.append(f"{place}: '{found[0]} …': begin with a noun: what it returns or is")
        for found in _ITEM.finditer(text):
            complaints.append(f"{place}: {found[1]} …: name the quantity: '`tau`: weight of …'")
    return complaints


def dangling_prose(modules: list[Module]) -> list[str]:
    """A docstring and each item in it begin with a noun, with a unit where it has one."""
    found = {module.path: dangling(module) for module in modules}
    return [text for texts in found.values() for text in texts]


STYLE_RULES = (
    asserted_work,
    bare_files,
    tables_of_units,
    named_tuples,
    names_of_two_classes,
    many_parameters,
    long_modules,
    missing_docstrings,
    missing_annotations,
    rounded_products,
    vague_words,
    dangling_prose,
)

# rule, file, source, part of the complaint
BROKEN_STYLE = [
    (asserted_work, "design/a.py", "assert (a := 1)", "a.py:1: an assertion that"),
    (asserted_work, "design/a.py", "assert isinstance(a := 1, int)", "does more than look"),
    (asserted_work, "design/a.py", "assert a.b is not None and a.pop()", "put it before"),
    (vague_words, "design/a.py", "told = 'alike: cannot be told apart'", "reported, given"),
    (dangling_prose, "design/a.py", '"""Of all designs, mm."""', "a.py:1: 'Of …': begin with"),
    (dangling_prose, "design/a.py", '"""The same of a study."""', "'The same …': begin"),
    (dangling_prose, "design/a.py", 'class A:\n    """What it is."""', "a.py:2: 'What …': begin"),
    (dangling_prose, "design/a.py", '"""A.\n\n- `b`, `c`:\n  of it."""', "`b`, `c`: of …: name"),
    (dangling_prose, "design/a.py", '"""A.\n\n`a`: mm; `tau`: as of B."""', "`tau`: as …: name"),
    (dangling_prose, "design/a.py", '"""A.\n\n- `a` (y, x): what it is."""', "`a` (y, x): what …"),
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
    (
        tables_of_units,
        "design/space.py",
        "R = {'beta': Reported('β', 'rad/mm²'), 'index': (unchecked(unit='mm'), 0.1)}",
        "space.py:1: a",
    ),
    (
        names_of_two_classes,
        "waveguide/z.py",
        "\n\nclass A: ...",
        "z.py:3: A is a class of units.py",
    ),
    (named_tuples, "lensless/psf.py", "class A(NamedTuple): ...", "psf.py:1: a named tuple"),
    (named_tuples, "units.py", "A = collections.namedtuple('A', 'x')", "units.py:1: "),
    (
        many_parameters,
        "lensless/psf.py",
        "def f(a, b, c, *, d, e, f, g=1): ...",
        "psf.py:1: f has 7 parameters, 6 allowed",
    ),
    (
        many_parameters,
        "lensless/psf.py",
        "class A:\n    def f(self, x):\n        def g(a, b, c, d, e, f, g): ...",
        "psf.py:3: g has 7",
    ),
    (
        many_parameters,
        "lensless/psf.py",
        "class A:\n    a: int\n    def __init__(self, a, b, c, d, e, f, g): ...",
        "psf.py:3: __init__ has 7",
    ),
    (long_modules, "lensless/psf.py", DOC + "x = 1\n" * MAX_LINES, "501 lines, 500 allowed"),
    (missing_docstrings, "lensless/psf.py", "x = 1", "begins with a docstring"),
    (missing_docstrings, "lensless/masks/__init__.py", "", "begins with a docstring"),
    (rounded_products, "learn/loss.py", "y = jnp.einsum('ij,j->i', a, x)", "loss.py:1: jnp.einsum"),
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
