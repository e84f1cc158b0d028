"""What a report shows: texts, tables and figures in parts, the same for pages and terminals."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from thincam_jax._core.files import read_regular
from thincam_jax._core.table import Table
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import slug
from thincam_jax.commands.sections import CamerasConfig


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


def render_report(page: Page, config: Any, pictures: Path, environment: dict[str, Any]) -> str:
    """A page as HTML, with the experiment's configuration and how it was computed at its end.

    - `pictures`: the folder of its figures.
    - `environment`: of the run, as `_core.environment.environment` gives it.

    Texts are escaped; a name that is missing is an error.
    """
    engine = jinja2.Environment(
        loader=jinja2.FunctionLoader(_template),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    kinds = {Table: "table", Picture: "picture", Sentences: "sentences", str: "text"}

    def picture(name: str) -> str | None:
        return data_url(pictures / name) if (pictures / name).exists() else None

    return engine.get_template("report.html.jinja").render(
        kind_of=lambda content: kinds[type(content)],
        page=page,
        parts=[part for part in page.parts if any(part.contents)],
        picture=picture,
        config=config,
        yaml=dump_config(config),
        environment=environment,
    )


def _template(name: str) -> str:
    return resources.files("thincam_jax.commands").joinpath(name).read_text(encoding="utf-8")


def data_url(picture: Path) -> str:
    """An image file as an address that holds it; its suffix is its kind."""
    content = base64.b64encode(read_regular(picture)).decode("ascii")
    return f"data:image/{picture.suffix[1:]};base64,{content}"
