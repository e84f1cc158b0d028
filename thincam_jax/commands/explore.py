"""The command `thincam explore`: the camera of a study on a page of this machine alone.

As the files `command.py`, it imports nothing at its head that `thincam --help` does not need.
"""

from typing import Annotated, Any

import typer

from thincam_jax.commands.terminal import ConfigFile, Overrides, reported, say_result

Port = Annotated[int, typer.Option(min=0, max=65535, help="Of the page; 0 takes a free one.")]
Browser = Annotated[bool, typer.Option(help="Open the page.")]


def serve_page(shown: Any, title: str, port: int, browser: bool) -> None:
    """Serve until Ctrl-C, and say where. **Errors**: ConfigError, one line."""
    from thincam_jax.commands.config_file import ConfigError
    from thincam_jax.plot.page import serve

    try:
        told_of = lambda at: say_result("address", at, f"{at}\nCtrl-C ends it.")  # noqa: E731
        serve(shown, title, port, told_of, browser)
    except ImportError:
        raise ConfigError("pages need pip install 'thincam_jax[notebook]'") from None
    except OSError as error:
        fault = f"--port {port}: {error.strerror}"
        raise ConfigError(f"{fault}; give another, or leave it out") from None


def explore(
    config: ConfigFile, set_: Overrides = None, port: Port = 0, browser: Browser = True
) -> None:
    """Turn the numbers of a study's first camera, on a page in the browser.

    Only this machine reaches it, and only with the address that is printed. Ctrl-C ends it.
    """
    with reported(lambda: "interrupted"):
        from thincam_jax.commands.kinds import load_study

        asked = load_study(config, tuple(set_ or ()), "explore takes a study")
        from thincam_jax.commands.study.build import build_study
        from thincam_jax.plot.explorer import Explorer

        study = build_study(asked)
        exposure = study.exposures[0]
        light = {"wavelength": exposure.wavelength, "object_distance": study.object_distance}
        explorer = Explorer(study.camera(exposure), **light)
        serve_page(explorer, asked.name, port, browser)
