"""What a report shows: texts, tables and figures in parts, the same for pages and terminals."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2

from thincam_jax._core.files import read_regular
from thincam_jax._core.table import number as number
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import slug

if TYPE_CHECKING:
    import rich.table


@dataclass(frozen=True)
class Table:
    """Rows of texts under headings; the first column names the rows.

    - `headings`: one a column; a line break stays one on a page.
    - `published`: columns of others' figures, set in grey.
    - `words`: columns of words, which are set to the left and may be long.
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    published: Sequence[int] = ()
    words: Sequence[int] = ()

    def __post_init__(self):
        for row in self.rows:
            if len(row) != len(self.headings):
                raise ValueError(f"{len(row)} cells under {len(self.headings)} headings: {row}")

    def in_terminal(self) -> "rich.table.Table":
        """The same for a terminal."""
        from thincam_jax.commands.terminal import numbers

        headings = [heading.replace("\n", " ") for heading in self.headings]
        return numbers([headings, *self.rows])


@dataclass(frozen=True)
class Picture:
    """A picture of the run's folder; one that was not drawn is left out.

    - `file`: its name among the figures.
    - `alt`: what it shows, for who cannot see it. `caption`: stands below.
    - `folded`: a line under which it is hidden until it is opened.
    """

    file: str
    alt: str
    caption: str = ""
    folded: str = ""


@dataclass(frozen=True)
class Sentences:
    """Sentences set as a list."""

    lines: Sequence[str]


Content = str | Table | Picture | Sentences


@dataclass(frozen=True)
class Part:
    """A part of a page with its heading, which the page's contents list by `short`."""

    title: str
    contents: Sequence[Content]
    short: str = ""

    @property
    def anchor(self) -> str:
        """Its place in the page's address."""
        return slug(self.short or self.title)


@dataclass(frozen=True)
class Page:
    """A report: what stands before the first part, the parts, and the command that made it.

    Between back quotes texts are code; empty texts, tables and parts are left out.
    """

    lead: Sequence[Content]
    parts: Sequence[Part] = ()
    command: str = "run"
    warnings: Sequence[str] = ()


def render_report(page: Page, config: Any, pictures: Path, environment: dict[str, Any]) -> str:
    """A page as HTML, with the experiment's configuration and how it was computed at its end.

    - `pictures`: the folder of its figures.
    - `environment`: of the run, as `doctor.environment` gives it.

    Texts are escaped; a name that is missing is an error.
    """
    kinds = {Table: "table", Picture: "picture", Sentences: "sentences", str: "text"}
    parts = [part for part in page.parts if any(part.contents)]
    given = {"kind_of": lambda content: kinds[type(content)], "environment": environment}
    return render("report.html.jinja", config, pictures, page=page, parts=parts, **given)


def render(template: str, config: Any, pictures: Path, **shown: Any) -> str:
    """Render a template of the commands with `config`, its `yaml`, `picture` by file, `shown`."""
    engine = jinja2.Environment(
        loader=jinja2.FunctionLoader(_template),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    engine.globals |= {"number": number, "slug": slug}

    def picture(name: str) -> str | None:
        return data_url(pictures / name) if (pictures / name).exists() else None

    given = {"config": config, "yaml": dump_config(config), "picture": picture, **shown}
    return engine.get_template(template).render(**given)


def _template(name: str) -> str:
    return resources.files("thincam_jax.commands").joinpath(name).read_text(encoding="utf-8")


def data_url(picture: Path) -> str:
    """An image file as an address that holds it; its suffix is its kind."""
    content = base64.b64encode(read_regular(picture)).decode("ascii")
    return f"data:image/{picture.suffix[1:]};base64,{content}"
