"""Pages of kinds whose report has a template of its own."""

from pathlib import Path
from typing import Any

from thincam_jax.commands.report import number as number
from thincam_jax.commands.report import render


def render_page(
    room: str, config: Any, pictures: Path, metrics: dict[str, Any], **shown: Any
) -> str:
    """The page of a room, from its template: the experiment, its metrics, how it was computed.

    - `pictures`: the folder of its figures.
    - `shown`: the `environment`, what else the template takes, and the `command` of the experiment.

    Texts are escaped; a name that is missing is an error.
    """
    given = {"command": "run", "warnings": metrics.get("warnings", ()), **shown}
    return render(f"{room}/page.html.jinja", config, pictures, metrics=metrics, **given)
