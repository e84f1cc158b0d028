"""What the report pages share: their frame, and pictures inside of the page."""

import base64
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from thincam_jax._core.files import read_regular
from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import slug


def render_page(
    room: str, config: Any, pictures: Path, metrics: dict[str, Any], **shown: Any
) -> str:
    """The page of a room, from its template: the experiment, its metrics, how it was computed.

    - `pictures`: the folder of its figures.
    - `shown`: the `environment`, what else the template takes, and the `command` of the experiment.

    Texts are escaped; a name that is missing is an error.
    """
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

    given = {"command": "run", "warnings": metrics.get("warnings", ()), **shown}
    given |= {"config": config, "metrics": metrics, "yaml": dump_config(config), "picture": picture}
    return engine.get_template(f"{room}/page.html.jinja").render(**given)


def _template(name: str) -> str:
    return resources.files("thincam_jax.commands").joinpath(name).read_text(encoding="utf-8")


def number(value: float | None, digits: int) -> str:
    """With so many decimals; a dash for none."""
    return "–" if value is None else f"{value:.{digits}f}"


def data_url(picture: Path) -> str:
    """An image file as an address that holds it; its suffix is its kind."""
    content = base64.b64encode(read_regular(picture)).decode("ascii")
    return f"data:image/{picture.suffix[1:]};base64,{content}"
