"""Contents of a report: texts, tables and figures in parts, for pages and terminals."""

import base64
import io
import os
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import quote

import jinja2
import PIL.Image

from thincam_jax._core.files import read_regular
from thincam_jax._core.table import Table
from thincam_jax._core.text import slug
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.sections import CamerasConfig


@dataclass(frozen=True)
class Picture:
    """A picture of the run's folder; one that was not drawn is left out.

    The page holds a small copy, with a link to the file; one that is folded it only links to.

    - `file`: its path from the folder of figures.
    - `alt`: content in words, for who cannot see it. `caption`: stands below.
    - `folded`: a line under which it is hidden until it is opened.
    """

    file: str
    alt: str
    caption: str = ""
    folded: str = ""


@dataclass(frozen=True)
class Gallery:
    """Pictures beside each other, each above its caption; as many in a row as the page is wide."""

    pictures: Sequence[Picture]


@dataclass(frozen=True)
class Sentences:
    """Sentences set as a list."""

    lines: Sequence[str]


Content = str | Table | Picture | Gallery | Sentences


@dataclass(frozen=True)
class Part:
    """A part of a page with its heading, which the page's contents list by `short`."""

    title: str
    contents: Sequence[Content]
    short: str = ""

    @property
    def anchor(self) -> str:
        """Anchor of the section in the page's address."""
        return slug(self.short or self.title)


@dataclass(frozen=True)
class Page:
    """A report: what stands before the first part, the parts, and the command that takes its file.

    Between back quotes texts are code; empty texts, tables and parts are left out.

    - `result`: the main result in a sentence, which stands first.
    """

    lead: Sequence[Content]
    parts: Sequence[Part] = ()
    command: str = "run"
    warnings: Sequence[str] = ()
    result: str = ""


def pixels_of(sensor: Any) -> str:
    """A section with the shape and pitch of a sensor, in words."""
    rows, columns = sensor.shape
    return f"Sensor {rows}×{columns} pixels of {sensor.pitch * 1000:g} µm"


def optics_of(config: CamerasConfig) -> str:
    """Light, PSF model, noise and seed of lensless cameras, in words."""
    noise = ""
    if config.noise is not None and config.noise.snr_db is not None:
        without = config.noise.signal_power == "without_mean"
        power = "signal power without the mean" if without else "total signal power"
        noise = f", Gaussian noise at {config.noise.snr_db:g} dB ({power})"
    light = f"λ = {config.wavelength * 1e6:g} nm, PSF model `{config.model}`"
    return f"{light}{noise}, seed {config.seed}."


def render_report(
    page: Page, config: Any, folder: Path, environment: dict[str, Any], figures: str = "figures"
) -> str:
    """A page as HTML, with the experiment's configuration and how it was computed at its end.

    - `folder`: folder of the page; `figures`: folder of its figures therein.
    - `environment`: environment of the run, by `_core.environment.environment`.

    Texts are escaped; a name that is missing is an error.
    """
    engine = jinja2.Environment(
        loader=jinja2.FunctionLoader(_template),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    kinds = {Table: "table", Picture: "picture", Gallery: "gallery", Sentences: "sentences"}

    def address(picture: Picture) -> str | None:
        """Address of the file from the page; None where it was not drawn."""
        path = os.path.normpath(Path(figures) / picture.file)
        return quote(path) if (folder / path).exists() else None

    return engine.get_template("report.html.jinja").render(
        kind_of=lambda content: kinds.get(type(content), "text"),
        page=page,
        parts=[part for part in page.parts if any(part.contents)],
        address=address,
        copy=lambda picture, width: small_copy(folder / figures / picture.file, width),
        config=config,
        yaml=dump_config(config),
        environment=environment,
    )


def _template(name: str) -> str:
    return resources.files("thincam_jax.commands").joinpath(name).read_text(encoding="utf-8")


def small_copy(picture: Path, width: int) -> str:
    """A picture of at most so many columns, as an address that holds it: WebP."""
    content = read_regular(picture)
    with PIL.Image.open(io.BytesIO(content)) as image:
        if not getattr(image, "is_animated", False):
            image.thumbnail((width, 4 * width))
            content = io.BytesIO()
            image.save(content, format="WebP", quality=85, method=2)  # half the time
            content = content.getvalue()
    return f"data:image/webp;base64,{base64.b64encode(content).decode('ascii')}"
