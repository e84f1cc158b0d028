"""The command `thincam explore`: the camera of a study on a page of this machine alone.

As the files `command.py`, it imports nothing at its head that `thincam --help` does not need.
"""

import secrets
import socket
from typing import Annotated

import typer

from thincam_jax.commands.terminal import ConfigFile, Overrides, say_result, told

_HOST = "127.0.0.1"


def explore(
    config: ConfigFile,
    set_: Overrides = None,
    port: Annotated[int, typer.Option(help="Of the page; 0 takes a free one.")] = 0,
    browser: Annotated[bool, typer.Option(help="Open the page.")] = True,
) -> None:
    """Turn the numbers of a study's first camera, on a page in the browser.

    Only this machine reaches it, and only with the address that is printed. Ctrl-C ends it.
    """
    with told(lambda: "interrupted"):
        from thincam_jax.commands.config_file import ConfigError
        from thincam_jax.commands.kinds import kind_of, load_study

        try:
            import uvicorn
        except ImportError:
            raise ConfigError("explore needs pip install 'thincam_jax[notebook]'") from None
        asked = load_study(config, tuple(set_ or ()), "explore takes a study")
        kind = kind_of(asked)
        from thincam_jax.plot.explorer import Explorer
        from thincam_jax.plot.explorer_page import page_of

        study = kind.part(kind.build)(asked)
        exposure = study.exposures[0]
        light = {"wavelength": exposure.wavelength, "object_distance": study.object_distance}
        explorer = Explorer(study.camera(exposure), **light)
        with socket.socket() as own:
            # A port whose last connections are not forgotten yet may be taken again.
            own.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                own.bind((_HOST, port))
                own.listen()  # requests wait until they are served
            except OSError as error:
                text = f"--port {port}: {error.strerror}; give another, or leave it out"
                raise ConfigError(text) from None
            host, token = f"{_HOST}:{own.getsockname()[1]}", secrets.token_urlsafe(32)
            address = f"http://{host}/?token={token}"
            say_result("address", address, f"{address}\nCtrl-C ends it.")
            if browser:
                import webbrowser

                webbrowser.open(address)
            served = uvicorn.Config(page_of(explorer, asked.name, host, token), log_level="warning")
            uvicorn.Server(served).run(sockets=[own])
