"""What the report pages share: their templates, and pictures inside of the page."""

import base64
from importlib import resources
from pathlib import Path

import jinja2


def load_template(room: str) -> jinja2.Template:
    """The page template of a room; texts are escaped, and a name that is missing is an error."""
    engine = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    source = resources.files(f"thincam_jax.commands.{room}").joinpath("page.html.jinja")
    return engine.from_string(source.read_text(encoding="utf-8"))


def data_url(picture: Path) -> str:
    """An image file as an address that holds it; its suffix is its kind."""
    content = base64.b64encode(picture.read_bytes()).decode("ascii")
    return f"data:image/{picture.suffix[1:]};base64,{content}"
