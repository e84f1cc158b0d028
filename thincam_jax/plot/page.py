"""A page of controls and pictures in the browser, served to its own machine alone."""

import dataclasses
import html
import json
import secrets
import socket
import webbrowser
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from thincam_jax._core.controls import Controlled
from thincam_jax._core.files import read_regular
from thincam_jax.plot.explore import MODULE

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


def page_of(shown: Controlled, title: str, host: str, token: str) -> "Starlette":
    """The page and its two other addresses; whatever else is asked for does not exist.

    A request has the host's name and, from a page, its origin, or it is another page's that the
    user's browser was led to: 403. So it is without the token.
    """
    from starlette.applications import Starlette
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
        try:
            if int(request.headers.get("content-length", _LONGEST + 1)) > _LONGEST:
                raise ValueError("the request is too long")
            asked: Any = await request.json()
            shown.turn(asked["values"])
            header, pictures = shown.view(rest=asked["rest"] is True).message()
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            return PlainTextResponse(str(error), 400)
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

    **Errors**: OSError where the port is taken; ImportError without the extra `notebook`.
    """
    import uvicorn

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
        served = uvicorn.Config(page_of(shown, title, host, token), log_level="warning")
        uvicorn.Server(served).run(sockets=[own])
