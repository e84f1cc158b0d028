"""The pages say what is so: their examples run, and what they name is there."""

import ast
import json
import os
import re
import runpy
import shlex
from pathlib import PurePosixPath

import jax
import jax.numpy as jnp
import numpy as np
import PIL.Image
import pytest
import skimage.data
import typer
import yaml
from commands.reconstruct import simulated

import thincam_jax as tc
from helpers import ROOT
from thincam_jax.commands import cli
from thincam_jax.commands.kinds import load_experiment
from thincam_jax.imaging.metrics import psnr
from thincam_jax.measured.write import log_text

PACKAGE = ROOT / "thincam_jax"


def run_examples(page: str) -> dict:
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text("utf-8"), re.DOTALL)
    assert blocks
    names: dict = {}
    for block in blocks:
        exec(block, names)  # the project's own pages
    return names


def test_readme(capsys):
    with jax.enable_x64(False):  # the precision of a user, of which programs are small
        names = run_examples("README.md")
    assert names["h"].shape == names["H"].shape == (1024, 1024)
    # The mean of ¼(1 + cos)² is 3/8 of the open aperture's light.
    assert abs(float(np.mean(names["h"][256:768, 256:768])) - 3 / 8) < 0.01
    assert np.isfinite(float(capsys.readouterr().out.split()[0]))


@pytest.mark.thorough
def test_start_page(capsys, monkeypatch, tmp_path):
    """With a photograph and a mask of one's own; the last image is near its scene."""
    monkeypatch.chdir(tmp_path)
    PIL.Image.fromarray(skimage.data.chelsea()).save("photo.jpg")
    cells = np.random.default_rng(0).integers(0, 2, (40, 40), dtype=np.uint8)
    PIL.Image.fromarray(np.kron(255 * cells, np.ones((10, 10), np.uint8))).save("mask.png")
    with jax.enable_x64(False):
        names = run_examples("docs/start.md")
    assert len(names["figure"].axes) == 2
    assert capsys.readouterr().out.split() == ["ok"]
    result, plane = names["result"], names["scene"].planes[0]
    truth = plane.sample(tc.Grid(result.image.shape[-2:], result.pitch), magnification=1.0)
    image, truth = (np.moveaxis(np.asarray(one), 0, -1) for one in (result.image, truth))
    assert psnr(image, truth) > 20


@pytest.mark.thorough
def test_accuracy_page(capsys):
    """The printed choice stands in the page, and the plan is within its tolerance."""
    names = run_examples("docs/guide/accuracy.md")
    printed = capsys.readouterr().out
    page = (ROOT / "docs/guide/accuracy.md").read_text("utf-8")
    assert not re.findall(r"\b[A-Z]{7,}\b", page)  # no figure left to be filled in
    choice = names["choice"]
    assert f"{choice.method.model} {choice.method.precision} {choice.predicted_error:.4f}" in page
    *told, rounding, fresnel = choice.reasons
    assert all(sentence in page and sentence in printed for sentence in (*told, fresnel))
    assert rounding in printed  # its last digit depends on the precision of the camera's numbers
    tc = names["tc"]  # the light of every point, as the plan chose; all planes and colours
    full = tc.capture(names["small"], names["scene"], model=tc.PsfMethod(field_tolerance=1.0))
    assert str(names["plan"]) in printed
    assert (
        str(names["plan"]).splitlines()[2:6]
        == re.findall(r"\n(field  .*\n.*\n.*\n.*)", page)[0].splitlines()
    )
    assert np.linalg.norm(names["image"] - full) < 1e-2 * np.linalg.norm(full)


@pytest.mark.thorough
def test_real_captures_page(tmp_path, monkeypatch, capsys):
    """The image is the scene, and what was done stands in its log."""
    monkeypatch.chdir(tmp_path)
    simulated.bayer_files(tmp_path)
    with jax.enable_x64(False):  # the precision of a user
        names = run_examples("docs/guide/real_captures.md")
    printed = capsys.readouterr().out
    assert "(3, 30, 38)" in printed
    assert "nan" not in printed
    ready, image = names["ready"], names["result"].image()
    assert ready.log.capture.background == "dark frame dark.tif"
    truth = simulated.scene().reshape(3, 30, 2, 38, 2).mean(axis=(2, 4))
    for channel, expected in zip(image, truth, strict=True):
        assert simulated.correlation(channel, expected) > 0.9
    with PIL.Image.open("result.png") as shown:
        assert shown.mode == "RGB" and shown.size == (38, 30)
    assert json.loads((tmp_path / "result.json").read_text("utf-8")) == json.loads(
        log_text(ready.log)
    )


@pytest.mark.thorough
def test_design_in_python_page():
    """The gradient through a reconstruction is the slope of what it is said to be."""
    with jax.enable_x64(False):  # the precision of a user
        names = run_examples("docs/guide/design_python.md")
    assert bool(jnp.isfinite(names["by_psf"]).all())
    for name in ("photo", "chart"):  # differences are taken in double precision
        names[name] = jnp.asarray(names[name], dtype=jnp.float64)
    psfs, step = jnp.asarray(names["psfs"], dtype=jnp.float64), 0.05
    ends = [float(names["misfit"](psfs, tau)) for tau in (2 - step, 2 + step)]
    np.testing.assert_allclose(float(names["by_tau"]), np.diff(ends)[0] / (2 * step), rtol=0.02)


NUMBER = r"[3-5]\.\d+"


def equations(text: str) -> set[str]:
    """The numbers in "3.6, 3.14-3.16": 3.6, 3.14, 3.15 and 3.16."""
    found = set()
    for first, last in re.findall(rf"({NUMBER})(?:[-–]({NUMBER}))?", text):
        chapter, start = first.split(".")
        end = (last or first).split(".")[1]
        found |= {f"{chapter}.{n}" for n in range(int(start), int(end) + 1)}
    return found


def cited(source: str) -> set[str]:
    """What a source file cites: "thesis Eq 3.14, 3.31" or "thesis Eq 3.14 and 3.31"."""
    citations = re.findall(rf"\bEq\.?\s+({NUMBER}(?:(?:[-–]|,\s+|\s+and\s+){NUMBER})*)", source)
    return set().union(*map(equations, citations))


def thesis_rows() -> list[tuple[set[str], str, str]]:
    """Equations, file and name of each row of docs/theory/thesis.md."""
    page = (ROOT / "docs/theory/thesis.md").read_text("utf-8")
    rows = re.findall(r"^\| ([\d., –]+) \|[^|]*\| `(.*?)` \| `(.*?)` \|", page, re.MULTILINE)
    return [(equations(numbers), file, name) for numbers, file, name in rows]


def defined(source: str) -> set[str]:
    """Functions and classes of a file, methods as `Class.method`."""
    kinds, found = (ast.FunctionDef, ast.ClassDef), set()
    for node in ast.parse(source).body:
        if isinstance(node, kinds):
            found.add(node.name)
            found |= {f"{node.name}.{part.name}" for part in node.body if isinstance(part, kinds)}
    return found


def test_every_row_of_the_thesis_page_names_what_exists():
    rows = thesis_rows()
    assert len(rows) > 25
    missing = [
        f"{file}: {name}"
        for _, file, name in rows
        if not (PACKAGE / file).is_file()
        or name not in defined((PACKAGE / file).read_text("utf-8"))
    ]
    assert not missing, "docs/theory/thesis.md names what is not there:\n" + "\n".join(missing)


def test_every_equation_that_a_file_cites_has_its_row():
    rows = thesis_rows()
    missing = [
        f"{file}: Eq {number}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for file in [path.relative_to(PACKAGE).as_posix()]
        for number in sorted(cited(path.read_text("utf-8")))
        if not any(number in numbers and file == where for numbers, where, _ in rows)
    ]
    assert not missing, "docs/theory/thesis.md lacks a row for:\n" + "\n".join(missing)


@pytest.mark.thorough
def test_flatcam_page():
    names = run_examples("docs/guide/flatcam.md")
    assert names["found"].operator.terms == 1 and names["sigma"].shape == (9, 12)
    assert psnr(np.asarray(names["result"].image), names["photograph"]) > 15
    found, truth = (
        np.einsum("kym,kxn->ymxn", o.left, o.right)
        for o in (names["calibrated"].operator, names["operator"])
    )
    np.testing.assert_allclose(found, truth, atol=1e-4 * np.abs(truth).max())
    assert not names["calibrated"].reason


def pages() -> dict[str, str]:
    """Pages of the documentation by their path below docs/."""
    folder, places = ROOT / "docs", ("*.md", "guide/*.md", "files/*.md", "theory/*.md")
    paths = [path for place in places for path in folder.glob(place)]
    return {path.relative_to(folder).as_posix(): path.read_text("utf-8") for path in paths}


def test_pages_are_few_and_listed():
    """At most 25 beside gallery and reference, each in the table of contents of its section."""
    listed = {"index.md"}
    for page, text in pages().items():
        entries = re.findall(r"```{toctree}\n(?::.*\n)*\n(.*?)```", text, re.DOTALL)
        names = re.findall(r"^(?:.*<)?([\w/]+)>?$", "\n".join(entries), re.MULTILINE)
        listed |= {(PurePosixPath(page).parent / f"{name}.md").as_posix() for name in names}
    assert set(pages()) <= listed
    assert len(pages()) <= 25


def test_pages_begin_with_a_picture():
    """Before their second heading."""
    contributing = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    for page, text in (pages() | {"contributing.md": contributing}).items():
        assert "![" in re.split(r"^##", text, maxsplit=1, flags=re.MULTILINE)[0], page


def notes() -> dict[str, str]:
    """What was measured and decided, by the path below docs/."""
    folder = ROOT / "docs"
    paths = [path for place in ("measured", "decisions") for path in (folder / place).glob("*.md")]
    return {path.relative_to(folder).as_posix(): path.read_text("utf-8") for path in paths}


def test_links_between_pages_lead_somewhere():
    """To files that are there; the scripts' pages and the reference are made with the site."""
    for page, text in (pages() | notes()).items():
        for target in re.findall(r"\]\(([\w./-]+\.(?:md|rst|png))", text):
            name = os.path.normpath(PurePosixPath(page).parent / target)
            made = name in ("gallery/index.rst", "api/index.md")
            script = ROOT / "experiments" / f"{PurePosixPath(name).stem}.py"
            assert made or (ROOT / "docs" / name).exists() or script.exists(), (page, target)


def test_links_to_headings_find_them():
    """By the site's rule for anchors: lower case, hyphens for spaces, no other punctuation."""
    every = pages() | notes()
    anchors = {
        page: {
            re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")
            for heading in re.findall(r"^#+ (.*)$", text, re.MULTILINE)
        }
        for page, text in every.items()
    }
    missing = [
        (page, target, anchor)
        for page, text in every.items()
        for target, anchor in re.findall(r"\]\(([\w./-]*)#([\w-]+)\)", text)
        if not target.startswith("http")
        if anchor
        not in anchors[os.path.normpath(PurePosixPath(page).parent / target) if target else page]
    ]
    assert not missing


TESTED = ("start", "guide/accuracy", "guide/real_captures", "guide/flatcam", "guide/screen")
TESTED += ("guide/screen_calibration", "guide/design_python")


@pytest.mark.thorough
@pytest.mark.parametrize(
    "page",
    [
        page
        for page, text in (pages() | notes()).items()
        if "```python\n" in text and page[:-3] not in TESTED
    ],
)
def test_examples_of_the_other_pages_run(page, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    with jax.enable_x64(False):
        assert run_examples(f"docs/{page}")


def test_picture_of_the_rooms_is_of_today():
    """Its imports are those of the source; the numbers of lines are of the day it was drawn."""
    script = runpy.run_path(str(ROOT / "docs/draw_rooms.py"))
    today = {room: used for room, (_, used) in script["rooms_and_imports"]().items()}
    assert script["imports_drawn"]() == today, "draw it again: python docs/draw_rooms.py"


@pytest.mark.thorough
def test_screen_page(capsys):
    names = run_examples("docs/guide/screen.md")
    np.testing.assert_allclose(names["rays"].wavelength / 1e-6, [532, 564.729], atol=1e-3)
    assert names["result"].image.shape[-2:] == (64, 64)
    assert names["plan"].meets_tolerance and names["capture"].shape == (3, 16, 12)
    assert names["fit"].truncation_error < 1e-3
    assert "ghosts" in capsys.readouterr().out


@pytest.mark.thorough
def test_screen_calibration_page(tmp_path, monkeypatch):
    """The glass is found; a uniform scene comes back, by the solver and by the stream."""
    monkeypatch.chdir(tmp_path)
    names = run_examples("docs/guide/screen_calibration.md")
    fit = names["fit"]
    error = fit.values["glass_thickness"] - 5.0
    assert abs(float(error)) < 4 * float(fit.standard_errors["glass_thickness"])
    assert fit.status == "ok"
    np.testing.assert_allclose(names["image"], 1, atol=0.02)


def blocks(*kinds: str) -> list[tuple[str, str]]:
    """Page and text of each block of a kind; those without one are ""."""
    named = "|".join(kinds)
    return [
        (page, text)
        for page, whole in pages().items()
        for kind, text in re.findall(r"^```(.*?)\n(.*?)^```", whole, re.MULTILINE | re.DOTALL)
        if re.fullmatch(named, kind)
    ]


# The shipped file into which a section of a page fits.
FITS = {
    "mask": "mura",
    "object": "moving",
    "plan": "rig_scene",
    "camera": "rig_scene",
    "optics": "rig_colour",
    "methods": "fza_harmonics",
    "models": "stis",
    "search": "design_pitches",
    "train": "design_distances",
    "pareto": "design_pareto",
    "pairs": "trained",
    "start": "trained",
    "guide/stis.md: mask": "stis",
}


def sections():
    """File, key and value of each section in YAML; a list is one of methods."""
    for page, text in blocks("yaml"):
        # A block shows several sections of a key below each other.
        for part in re.split(r"^(?=\w)", text, flags=re.MULTILINE):
            found = yaml.safe_load(part)
            found = {"methods": found} if isinstance(found, list) else found or {}
            for key, value in found.items():
                name = f"{page}: {key}"
                yield pytest.param(FITS.get(name) or FITS[key], key, value, id=name)


@pytest.mark.parametrize(("file", "key", "value"), list(sections()))
def test_a_section_of_a_page_fits_into_an_experiment(file, key, value):
    """In place of the file's own; a plan changes the entries that it names."""
    entries = (
        {f"plan.{name}": one for name, one in value.items()} if key == "plan" else {key: value}
    )
    overrides = tuple(f"{path}={json.dumps(one)}" for path, one in entries.items())
    config = load_experiment(ROOT / f"configs/{file}.yaml", overrides, None)
    assert getattr(config, key)


def command_lines():
    """Page and words of each call of the command in a page."""
    for page, text in blocks("sh", ""):
        lines = text.replace("\\\n", " ").replace("; thincam", "\nthincam").splitlines()
        for line in lines:
            if re.match(r"(\S*/)?thincam ", line):
                yield pytest.param(shlex.split(line, comments=True)[1:], id=f"{page}: {line}")


@pytest.mark.parametrize("words", list(command_lines()))
def test_a_command_of_a_page_has_these_options_and_files(words):
    command = typer.main.get_command(cli.app)
    while hasattr(command, "commands"):
        command, words = command.commands[words[0]], words[1:]
    known = {name for one in command.params for name in (*one.opts, *one.secondary_opts)}
    given = {word.strip("[]").split("=")[0] for word in words if re.match(r"\[?--", word)}
    assert given <= known
    assert all((ROOT / word).is_file() for word in words if word.startswith("configs/"))
