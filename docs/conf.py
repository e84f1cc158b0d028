"""The documentation: Sphinx with pages in Markdown, the scripts of experiments/ as a gallery.

`make docs` executes the scripts whose text has changed; `make docs FAST=1` executes none.
"""

import ast
import importlib
import os
import re
import textwrap
from importlib.metadata import files
from pathlib import Path

from PIL import Image

DOCS = Path(__file__).parent
PACKAGE = DOCS.parent / "thincam_jax"

project = "thincam_jax"
author = "The thincam_jax developers"
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["_build", "gallery/*.ipynb"]
default_role = "py:obj"  # `name` in a docstring: a link where the name is known, else code
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 4

html_theme = "pydata_sphinx_theme"
html_title = "thincam_jax"
MATHJAX = next(f for f in files("sphinx-mathjax-offline") or () if f.name == "tex-svg.js")
html_static_path = ["_static", str(MATHJAX.locate())]
html_css_files = ["site.css"]
templates_path = ["_templates"]
html_copy_source = False
html_show_sourcelink = False
mathjax_path = "tex-svg.js"  # a copy: no page asks another machine for anything
html_theme_options = {
    "header_links_before_dropdown": 7,
    "navbar_align": "left",
    "navbar_persistent": ["search-button"],
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}
html_context = {"default_mode": "auto"}  # light or dark as the reader's system
html_sidebars = {"index": [], "start": [], "contributing": []}

autodoc_typehints = "none"
autodoc_member_order = "bysource"
toc_object_entries_show_parents = "hide"

# The scripts write their figures, too, and one reads photographs that are no part of the project.
os.environ["THINCAM_FIGURES"] = str(DOCS / "_build/figures")
PHOTOGRAPHS = DOCS.parents[1] / "shared/data/photographs"
PHOTOGRAPHS = Path(os.environ.setdefault("THINCAM_PHOTOGRAPHS", str(PHOTOGRAPHS)))
sphinx_gallery_conf = {
    "examples_dirs": "../experiments",
    "gallery_dirs": "gallery",
    "filename_pattern": r"/[^/]*\.py$" if PHOTOGRAPHS.exists() else r"/(?!denoiser)[^/]*\.py$",
    "plot_gallery": "FAST" not in os.environ,
    "download_all_examples": False,
    "remove_config_comments": True,
    "thumbnail_size": (400, 400),
    "write_computation_times": False,  # a table that asks other machines for its scripts
}


TOP = "thincam_jax"
# The API reference: for each package a page of its public names below their module's first line.
PACKAGES = (
    TOP,
    "thincam_jax.lensless",
    "thincam_jax.lensless.masks",
    "thincam_jax.imaging.targets",
    "thincam_jax.imaging.operators",
    "thincam_jax.imaging.metrics",
    "thincam_jax.waveguide",
    "thincam_jax.reconstruction",
    "thincam_jax.reconstruction.depth",
    "thincam_jax.measured",
    "thincam_jax.measured.calibration",
    "thincam_jax.design",
    "thincam_jax.studies",
    "thincam_jax.learn",
    "thincam_jax.plot",
    "thincam_jax.hardware",
    "thincam_jax.hardware.virtual",
)
# Modules that scripts and pages use beyond these names; versions do not promise them.
MODULES = (
    "design.cell_masks",
    "design.cell_search",
    "design.expected_error",
    "design.recommendation",
    "design.least_error",
    "design.match",
    "design.objectives",
    "design.phase_mask",
    "design.phase_retrieval",
    "design.setup",
    "waveguide.design.plate",
    "design.relief_files",
    "hardware.acquisition.plan",
    "hardware.acquisition.taker",
    "hardware.base",
    "hardware.displays.levels",
    "hardware.virtual.optics",
    "hardware.virtual.rig",
    "imaging.metrics.mtf",
    "imaging.metrics.usaf",
    "imaging.operators.base",
    "imaging.operators.crop_convolution",
    "imaging.operators.low_rank",
    "imaging.operators.masked",
    "imaging.operators.separable",
    "imaging.refractive_index",
    "imaging.targets.images",
    "imaging.targets.patterns",
    "imaging.targets.usaf",
    "learn.denoiser.pictures",
    "learn.sources",
    "learn.tau",
    "learn.imperfections",
    "learn.trained",
    "learn.trained_lessons",
    "learn.trained_training",
    "learn.training",
    "lensless.exposures",
    "lensless.forward",
    "lensless.masks.display",
    "lensless.masks.halftone",
    "lensless.masks.phase",
    "lensless.masks.written",
    "lensless.phase_shift",
    "lensless.propagation.angular_spectrum",
    "measured.bayer",
    "measured.calibration.hadamard",
    "waveguide.measured.screen_fit",
    "measured.examination",
    "measured.exposures",
    "measured.layouts",
    "measured.pairs",
    "reconstruction.exchange",
    "reconstruction.iterate",
    "reconstruction.noise",
    "reconstruction.problem",
    "reconstruction.solver",
    "studies.design",
    "studies.evaluate",
    "studies.intervals",
    "studies.prepared",
    "waveguide.colours",
    "waveguide.distance",
    "waveguide.display",
    "waveguide.field_of_view",
    "waveguide.lens",
    "waveguide.rays",
    "waveguide.screen_to_sensor",
    "waveguide.smear",
    "waveguide.studies.screen",
)


def source(module: str) -> ast.Module:
    """Syntax tree of a module, or of the stub that holds the names of a lazy package."""
    path = PACKAGE.parent / module.replace(".", "/")
    places = (path / "__init__.pyi", path / "__init__.py", path.with_suffix(".py"))
    return ast.parse(next(p for p in places if p.exists()).read_text("utf-8"))


def first_line(module: str) -> str:
    return ast.get_docstring(source(module)).splitlines()[0].rstrip(".")


ROOMS = {  # headings of the names at the top level, in the order of the page
    "imaging": "Scenes, sensors and noise",
    "_core": "Scenes, sensors and noise",
    "lensless": "Cameras, PSFs and captures",
    "lensless.masks": "Masks",
    "lensless.accuracy": "Accuracy",
    "lensless.plan": "Accuracy",
    "reconstruction": "Reconstruction",
    "learn": "Reconstruction",
    "measured": "Calibration",
    "plot": "Figures",
}


def heading(package: str, module: str) -> str:
    if package != TOP:
        return first_line(module)
    return ROOMS[max((room for room in ROOMS if module.startswith(f"{TOP}.{room}")), key=len)]


def reference_page(package: str, seen: set[tuple[str, str]]) -> str:
    """Tables of the names of a package that stand on no earlier page."""
    groups: dict[str, list[str]] = {title: [] for title in ROOMS.values() if package == TOP}
    for node in source(package).body:
        if isinstance(node, ast.ImportFrom) and (node.module or package != TOP):
            for alias in (one for one in node.names if one.asname):  # `x as x`: public
                inside = ".".join(filter(None, (package, node.module)))
                module = inside if node.level else node.module
                named = getattr(importlib.import_module(package), alias.name)
                made_in = getattr(named, "__module__", module)  # "typing" of an alias of types
                module = made_in if made_in.startswith(TOP) else module
                if (module, alias.name) not in seen:
                    seen.add((module, alias.name))
                    groups.setdefault(heading(package, module), []).append(alias.name)
    title = package.replace(f"{TOP}.", "tc.")  # short enough for the sidebar
    lines = [title, "=" * len(title), ""]
    if package == TOP:
        lines += ["The names that most programs need, by ``import thincam_jax as tc``.", ""]
    else:
        lines += [f".. automodule:: {package}", "   :no-index:", ""]
    for title, names in groups.items():
        lines += [title, "-" * len(title) * 2, "", f".. currentmodule:: {package}", ""]
        lines += [".. autosummary::", "   :toctree: generated", "", *(f"   {n}" for n in names), ""]
    return "\n".join(lines)


def modules_page() -> str:
    """Tables of what the modules define that versions do not promise."""
    lines = ["Modules", "=======", "", "They may change without notice.", ""]
    for name in MODULES:
        names = [
            node.name
            for node in source(f"{TOP}.{name}").body
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name[0] != "_"
        ]
        lines += [name, "-" * len(name), "", first_line(f"{TOP}.{name}") + ".", ""]
        lines += [f".. currentmodule:: {TOP}.{name}", "", ".. autosummary::", ""]
        lines += [*(f"   {n}" for n in names), ""]
    return "\n".join(lines)


def write_reference(folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    seen: set[tuple[str, str]] = set()
    pages = {package: reference_page(package, seen) for package in PACKAGES}
    for name, text in {**pages, "modules": modules_page()}.items():
        page = folder / f"{name}.rst"
        if not page.exists() or page.read_text("utf-8") != text:
            page.write_text(text, "utf-8")


write_reference(DOCS / "api")


# Docstrings are plain text with single backticks and fenced code: `|x|` is a norm, a lone `*` no
# emphasis. Blocks and inline code stay as they are.
FENCE = re.compile(r"^( *)```python\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)
MARKUP = re.compile(
    r"^( *)(?:\.\. |[^\n]*::$)[^\n]*\n(?:\1 +[^\n]*\n|\n)*"
    r"|``.+?``|`[^`]+`(?P<joined>(?=\w))?|\*\*\S[^*]*\*\*|(?<![\w(])\*\w[^*\n]*[\w.,;?]\*(?!\w)"
    r"|(?P<bare>[*|])",
    re.MULTILINE | re.DOTALL,
)


def code_block(fence: re.Match) -> str:
    indent, code = fence.groups()
    return f"{indent}.. code-block:: python\n\n{textwrap.indent(code, '   ')}"


def escape(found: re.Match) -> str:
    if found["bare"]:
        return "\\" + found[0]
    return found[0] + ("\\ " if found["joined"] is not None else "")


def to_rst(app, what, name, obj, options, lines):
    if what == "data":  # a constant has the docstring of its type
        lines.clear()
    text = FENCE.sub(code_block, "\n".join(lines) + "\n")
    lines[:] = MARKUP.sub(escape, text).split("\n")


# A script's card in the gallery is one square of a figure of docs/images: left, top and side in
# pixels. The scripts' figures have many panels, which nobody could read at that size.
CARDS = {
    "atlas_of_masks": ("atlas-masks.png", 437, 25, 179),
    "calibrate_psf": ("calibration.png", 402, 66, 186),
    "colour_sensor": ("rig-colour.png", 362, 66, 192),
    "compare_masks": ("masks.png", 185, 20, 147),
    "data_set": ("data-set.png", 208, 26, 130),
    "denoiser": ("denoiser.png", 0, 0, 418),
    "designs_as_made": ("as-made-cells.png", 68, 36, 234),
    "field_design": ("field-design.png", 770, 28, 299),
    "field_of_view": ("field-of-view.png", 700, 727, 104),
    "first_image": ("first-image.png", 969, 31, 273),
    "flatcam": ("flatcam.png", 956, 389, 287),
    "free_form_design": ("free-form-masks.png", 127, 0, 127),
    "full_size_design": ("full-size-mask.png", 332, 52, 224),
    "gradients_through_the_solver": ("solver-gradients.png", 126, 12, 399),
    "in_a_notebook": ("usaf-1951.png", 1182, 326, 186),
    "limit_of_masks": ("limit-spectra.png", 64, 27, 262),
    "mosaic": ("mosaic-psf.png", 58, 33, 350),
    "moving_objects": ("moving-objects.png", 592, 31, 256),
    "near_screen": ("near-screen.png", 128, 30, 297),
    "optical_chart": ("optical-chart-lines.png", 893, 44, 190),
    "other_packages": ("other-packages.png", 270, 42, 251),
    "own_sensor": ("design-landscape.png", 169, 4, 369),
    "phase_mask": ("phase-masks.png", 800, 345, 162),
    "prior": ("prior.png", 1016, 48, 294),
    "real_capture": ("real-capture.png", 676, 52, 140),
    "refocus": ("depth.png", 1032, 60, 150),
    "screen_distance": ("screen-distance.png", 702, 25, 293),
    "simulated_rig": ("rig.png", 707, 27, 280),
    "speed_for_accuracy": ("accuracy.png", 40, 40, 752),
    "stis_camera": ("stis.png", 629, 37, 199),
    "sts_camera": ("sts-camera.png", 604, 23, 216),
    "sts_conditions": ("sts-conditions.png", 351, 23, 105),
    "sts_design": ("screen-design.png", 24, 0, 374),
    "sts_realtime": ("sts-speed.png", 575, 0, 418),
    "superresolution": ("usaf-1951.png", 948, 99, 205),
    "three_lines": ("three-lines.png", 815, 34, 252),
    "video": ("video.png", 854, 21, 223),
    "when_it_looks_wrong": ("when-it-looks-wrong.png", 47, 826, 258),
    "trained_diffusercam": ("trained-hand.png", 1085, 296, 200),
    "trained_reconstruction": ("trained-simulated.png", 1460, 495, 180),
    "your_own_mask": ("own-mask.png", 715, 40, 194),
}


def draw_cards(app) -> None:
    """Put each script's square in place of the picture that the gallery has made."""
    side = sphinx_gallery_conf["thumbnail_size"]
    for script in (DOCS.parent / "experiments").glob("*.py"):
        name, left, top, size = CARDS[script.stem]
        figure = Image.open(DOCS / "images" / name).convert("RGBA")
        panel = figure.crop((left, top, left + size, top + size))
        card = Image.new("RGBA", panel.size, "white")
        card.alpha_composite(panel)
        thumbnail = DOCS / "gallery/images/thumb" / f"sphx_glr_{script.stem}_thumb.png"
        card.convert("RGB").resize(side, Image.Resampling.BICUBIC).save(thumbnail)


def describe_names(app, docname: str, text: list[str]) -> None:
    """Make of each task's names in the list of the reference a table with their first lines."""

    def table(task: re.Match) -> str:
        prefix = "hardware.plans." if "functions of" in task[2] else ""
        listed, _, functions = task[2].partition(", and the functions of `tc.hardware.plans`:")
        names = [name.removeprefix("tc.") for name in re.findall(r"`(.+?)`", listed)]
        names += [prefix + name for name in re.findall(r"`(.+?)`", functions)]
        lines = [".. currentmodule:: thincam_jax", "", ".. autosummary::", ""]
        lines += [f"   {name}" for name in names]
        return "\n".join([f"### {task[1]}", "", "```{eval-rst}", *lines, "```", ""])

    bullets = re.compile(r"^- \*\*(.+?)\*\*: ((?:.+\n  )*.+\.)$", re.MULTILINE)
    if docname == "api/index":
        text[0] = bullets.sub(table, text[0])


def setup(app):
    app.connect("source-read", describe_names)
    app.connect("autodoc-process-docstring", to_rst)
    app.connect("builder-inited", draw_cards, priority=900)  # after the gallery, at 500
