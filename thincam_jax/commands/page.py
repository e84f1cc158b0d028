"""What the report pages share: their frame, and pictures inside of the page."""

from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from thincam_jax.commands.checked_config import dump_config
from thincam_jax.commands.config_file import slug
from thincam_jax.commands.report import data_url, number


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
