"""A web server for this machine alone: bound to 127.0.0.1, deaf to pages from elsewhere, without a public tunnel."""

from __future__ import annotations

import contextlib
import http
import io
import os
import socket
import threading
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

import viser
import websockets.asyncio.server
from viser import _messages as messages
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from ..config import ConfigError

HOST = "127.0.0.1"
PORT = 8080
_NAMES = (HOST, "localhost")  # by which a browser on this machine may call the server
_PATCHING = threading.Lock()


@contextmanager
def serving(port: int | None = None, label: str = "softtwin") -> Iterator[viser.ViserServer]:
    """A server that is stopped at the end.

    Args:
        port: to listen on; the first free one from 8080 on if not given.
        label: title of the panel.

    Raises:
        ConfigError: the port is taken, or may not be used.
    """
    if port is not None:
        _check_free(port)
    server = _started(PORT if port is None else port, label)
    try:
        _refuse_tunnel(server)
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):  # it says that it stops, in the middle of our last words
            server.stop()


def address(server: viser.ViserServer) -> str:
    """Where a browser on this machine finds the page."""
    return f"http://{HOST}:{server.get_port()}"


def has_display() -> bool:
    """Whether a browser can open a window here."""
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def open_browser(server: viser.ViserServer) -> bool:
    """Show the page in the person's browser; False where there is no display, or no browser."""
    return has_display() and webbrowser.open(address(server))


def refusal(host: list[str], origin: list[str], port: int, is_socket: bool) -> str | None:
    """Why a request is refused; None where it is not.

    A page from elsewhere that a person has open could otherwise read and steer this one: by a websocket, which no
    browser keeps from other origins, or under a name of its own that it lets point to this machine.

    Args:
        host: values of the request's header Host.
        origin: values of its header Origin.
        port: that the server listens on.
        is_socket: whether a websocket is asked for.
    """
    places = [f"{name}:{port}" for name in _NAMES]
    if len(host) != 1 or host[0].lower() not in places:
        return f"this page is for this machine alone: open http://{places[0]}, through a tunnel at the same port."
    if not origin:
        return "a websocket without an Origin is refused." if is_socket else None
    known = [f"http://{place}" for place in places]
    return None if len(origin) == 1 and origin[0].lower() in known else f"pages from {origin[0]} are refused."


def _check_free(port: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise ConfigError(
                f"--port: expected a free port, got {port} ({error.strerror}); choose another, or leave --port out."
            ) from None


def _started(port: int, label: str) -> viser.ViserServer:
    """A server of viser, guarded; what it prints about itself is left out."""
    with _guarded() as guards, contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=HOST, port=port, label=label, verbose=False)
    if not guards:
        server.stop()
        raise RuntimeError("the page's server could not be guarded: this version of viser starts it in another way.")
    return server


@contextmanager
def _guarded() -> Iterator[list[int]]:
    """While this holds, a server of websockets asks each request where it comes from; yields one entry a server.

    viser 1.1 hands no such question to websockets, which has it, and gives no hook for one.
    """
    guards: list[int] = []
    with _PATCHING:
        plain = websockets.asyncio.server.serve

        def serve(handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
            guards.append(port)
            return plain(handler, host, port, process_request=_asked_first(process_request), **options)

        websockets.asyncio.server.serve = serve  # type: ignore[assignment,misc]
        try:
            yield guards
        finally:
            websockets.asyncio.server.serve = plain  # type: ignore[misc]


_Answer = Callable[[ServerConnection, Request], Response | None]


def _asked_first(process: _Answer) -> _Answer:
    def asked(connection: ServerConnection, request: Request) -> Response | None:
        headers = request.headers
        is_socket = any("websocket" in value.lower() for value in headers.get_all("Upgrade"))
        port = connection.local_address[1]
        why = refusal(headers.get_all("Host"), headers.get_all("Origin"), port, is_socket)
        if why is not None:
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"softtwin: {why}\n")
        return process(connection, request)

    return asked


def _refuse_tunnel(server: viser.ViserServer) -> None:
    """Take away what viser has to publish a page on the internet: its button, and what a browser's message starts."""
    for message in (messages.ShareUrlRequest, messages.ShareUrlDisconnect):
        server._websock_server.unregister_handler(message)
    server.request_share_url = _no_tunnel  # type: ignore[method-assign]


def _no_tunnel(*_: Any, **__: Any) -> NoReturn:
    raise RuntimeError("the page is for this machine alone: it has no public address.")
