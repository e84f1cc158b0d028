"""A page of controls and pictures in the browser, served to its own machine alone."""

import dataclasses
import html
import json
import secrets
import socket
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number
from thincam_jax._core.controls import Controlled
from thincam_jax._core.files import read_regular
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.plot.explorer import Explorer
from thincam_jax.units import nm

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response


_PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<meta name="color-scheme" content="light dark">
<title>{title}</title>
<body style="max-width: 1180px; margin: 1rem auto; padding: 0 1rem">
<script type="module">
import {{ byFetch, mount }} from "/explorer.js?token={token}";
mount(document.body, {controls}, byFetch("/view", "{token}"), {captions}, {live});
</script>
</body>
</html>
"""
_POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src blob: data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
_HOST = "127.0.0.1"
_LONGEST = 10_000  # bytes of a request
_PATIENCE = 10.0  # s until a request is whole
# Of every answer. A connection has one request, so that its time is that of the connection.
_HEADERS = [
    ("Connection", "close"),
    ("Cache-Control", "no-store"),
    ("X-Content-Type-Options", "nosniff"),
]


def page_of(shown: Controlled, title: str, host: str, token: str) -> "Starlette":
    """The page and its two other addresses; no other one exists.

    A request has the host's name and, from a page, its origin, or it is another page's that the
    user's browser was led to: 403. So it is without the token.
    """
    from starlette.applications import Starlette
    from starlette.requests import ClientDisconnect
    from starlette.responses import HTMLResponse, PlainTextResponse, Response
    from starlette.routing import Route

    def refused(request: "Request", given: str | None) -> "Response | None":
        origin = request.headers.get("origin")
        foreign = request.headers.get("host") != host or origin not in (None, f"http://{host}")
        if foreign or given is None or not secrets.compare_digest(given.encode(), token.encode()):
            return PlainTextResponse("use the address that thincam has printed", 403)
        return None

    async def page(request: "Request") -> "Response":
        controls = json.dumps([dataclasses.asdict(one) for one in shown.controls])
        text = _PAGE.format(
            title=html.escape(title),
            token=token,
            controls=controls.replace("<", "\\u003c"),
            captions=json.dumps(shown.captions),
            live=json.dumps(shown.live),
        )
        headers = {"Content-Security-Policy": _POLICY, "Referrer-Policy": "no-referrer"}
        return refused(request, request.query_params.get("token")) or HTMLResponse(
            text, headers=headers
        )

    async def module(request: "Request") -> "Response":
        return refused(request, request.query_params.get("token")) or Response(
            read_regular(MODULE), media_type="text/javascript"
        )

    async def view(request: "Request") -> "Response":
        given = request.headers.get("authorization", "").removeprefix("Bearer ")
        if (answer := refused(request, given)) is not None:
            return answer
        content = bytearray()
        try:
            async for part in request.stream():
                content += part
                if len(content) > _LONGEST:
                    raise ValueError("the request is too long")
            asked: Any = json.loads(content)
            shown.turn(asked["values"])
            header, pictures = shown.view(rest=asked["rest"] is True).message()
        except (ValueError, TypeError, LookupError, AttributeError, OverflowError) as error:
            return PlainTextResponse(str(error).encode("utf-8", "backslashreplace"), 400)
        except (RecursionError, ClientDisconnect):
            return PlainTextResponse("the request is nested too deeply, or ends half-way", 400)
        parts = [header.encode("utf-8"), *pictures]
        lengths = ",".join(str(len(part)) for part in parts)
        return Response(b"".join(parts), headers={"X-Lengths": lengths})

    return Starlette(
        routes=[
            Route("/", page),
            Route("/explorer.js", module),
            Route("/view", view, methods=["POST"]),
        ]
    )


def serve(
    shown: Controlled, title: str, port: int, announce: Callable[[str], object], browser: bool
) -> None:
    """Serve the page until Ctrl-C, only to this machine and to who knows the printed address.

    - `port`: 0 takes a free one. `announce` is given the address; `browser`: opens it.

    A request of more than 10 kB is refused while it is read; one that is not whole after 10 s, and
    at Ctrl-C, is dropped with its connection.

    **Errors**: OSError where the port is taken; ImportError without the extra `notebook`.
    """
    import uvicorn
    from uvicorn.protocols.http.h11_impl import H11Protocol

    class Protocol(H11Protocol):
        """HTTP that ends a connection whose request does not come whole in time."""

        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            self.loop.call_later(_PATIENCE, self._abort_if_incomplete)

        def shutdown(self) -> None:
            self._abort_if_incomplete()
            super().shutdown()

        def _abort_if_incomplete(self) -> None:
            if self.cycle is None or self.cycle.more_body:
                self.transport.abort()

    with socket.socket() as own:
        # A port whose last connections are not forgotten yet may be taken again.
        own.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        own.bind((_HOST, port))
        own.listen()  # requests wait until they are served
        host, token = f"{_HOST}:{own.getsockname()[1]}", secrets.token_urlsafe(32)
        address = f"http://{host}/?token={token}"
        announce(address)
        if browser:
            webbrowser.open(address)
        served = uvicorn.Config(
            page_of(shown, title, host, token),
            http=Protocol,
            ws="none",
            log_level="error",
            headers=_HEADERS,
            timeout_graceful_shutdown=1,
        )
        uvicorn.Server(served).run(sockets=[own])


MODULE = Path(__file__).with_name("explorer.js")


@checked
def explore(
    camera: LenslessCamera,
    scene: Any = None,
    *,
    wavelength: Number = 550 * nm,
    object_distance: Number = 250.0,
) -> Any:
    """Turn the numbers of a camera and see its PSF, transfer function, capture and image.

    A widget for Jupyter, VS Code, Colab and marimo. `widget.camera` is the camera as it is set,
    `widget.light` the wavelength and the distance of the object. Arguments as of `Explorer`; on a
    page of its own, without a notebook, it is `thincam explore`.

    **Errors**: ImportError without the extra `notebook`.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((96, 128), 15 * um), distance=5.0)
    widget = tc.explore(camera)
    print(widget.camera.distance)  # 5.0
    ```

    **See also**: `plot.psf`, `plot.otf`.
    """
    try:
        import anywidget
        import traitlets
    except ImportError:
        raise ImportError(
            "tc.explore needs anywidget; pip install 'thincam_jax[notebook]'"
        ) from None
    explorer = Explorer(camera, scene, wavelength=wavelength, object_distance=object_distance)

    class Widget(anywidget.AnyWidget):
        _esm = MODULE
        controls = traitlets.List().tag(sync=True)
        camera = property(lambda self: explorer.camera)
        light = property(lambda self: explorer.light)

    def answer(widget: Any, message: Any, buffers: Any) -> None:
        explorer.turn(message["values"])
        header, pictures = explorer.view(rest=message["rest"]).message()
        widget.send({"id": message["id"], "header": header}, pictures)

    widget = Widget(controls=[dataclasses.asdict(control) for control in explorer.controls])
    widget.on_msg(answer)
    return widget
