"""The examples of docstrings: every public name has a short one, and all of them run."""

import ast
import contextlib
import doctest
import inspect
import io
import operator
import re

import jax
import matplotlib.pyplot as plt
import pytest

import thincam_jax as tc
from helpers import ROOT

EXAMPLE = re.compile(r"^ *```python\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)
STUB = ast.parse((ROOT / "thincam_jax/__init__.pyi").read_text("utf-8"))
NAMES = [
    alias.name
    for node in STUB.body
    if isinstance(node, ast.ImportFrom) and node.module
    for alias in node.names
    if callable(getattr(tc, alias.name))
]
QUICK = ("Grid", "Sensor", "load_image", "LenslessCamera", "psf", "RadialMask", "AxisFactors")


@pytest.mark.parametrize("name", NAMES)
def test_a_public_name_has_a_short_example_and_says_what_to_see(name):
    text = inspect.getdoc(getattr(tc, name))
    (example,) = EXAMPLE.findall(text)
    assert len([line for line in example.splitlines() if line.strip()]) <= 8
    (seen,) = re.findall(r"\*\*See also\*\*: (.*)\.\Z", text)
    assert all(operator.attrgetter(other)(tc) for other in re.findall(r"`([\w.]+)`", seen))


def examples():
    """Name and code of each example in the docstrings of the package."""
    for path in sorted((ROOT / "thincam_jax").rglob("*.py")):
        text = path.read_text("utf-8")
        for node in ast.walk(ast.parse(text)) if "```python" in text else ():
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                for code in EXAMPLE.findall(ast.get_docstring(node) or ""):
                    marks = [] if node.name in QUICK else [pytest.mark.thorough]
                    yield pytest.param(code, id=f"{path.stem}:{node.name}", marks=marks)


@pytest.mark.parametrize("code", list(examples()))
def test_an_example_runs_and_prints_what_it_says(code, monkeypatch, tmp_path):
    """In a user's precision; what stands behind `print(…)  #` is what it prints."""
    monkeypatch.chdir(tmp_path)
    printed = io.StringIO()
    with jax.enable_x64(False), jax.numpy_dtype_promotion("standard"):
        with contextlib.redirect_stdout(printed):
            exec(code, {})
    plt.close("all")
    quoted = re.findall(r"^print\(.*\)  # (.*)$", code, re.MULTILINE)
    assert not quoted or quoted == printed.getvalue().splitlines()


def test_the_example_of_the_package_prints_what_it_says():
    """That of `help(thincam_jax)`, which is no block."""
    test = doctest.DocTestParser().get_doctest(tc.__doc__, {}, "thincam_jax", None, None)
    with jax.enable_x64(False), jax.numpy_dtype_promotion("standard"):
        found = doctest.DocTestRunner().run(test)
    assert found.attempted == 5 and not found.failed
