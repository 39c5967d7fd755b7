"""The page's server: for this machine alone, deaf to pages from elsewhere, without a public address."""

import io
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import pytest

viser = pytest.importorskip("viser", reason="viser is absent")
import msgspec  # comes with viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from softtwin.app.config import ConfigError
from softtwin.app.page import server as page

PROTOCOL = f"viser-v{viser.__version__}"


@pytest.fixture
def server() -> Iterator[Any]:
    with page.serving() as found:
        yield found


def socket_of(port: int, **options: Any) -> ClientConnection:
    return connect(f"ws://127.0.0.1:{port}", subprotocols=[PROTOCOL], compression=None, max_size=None, **options)


def own(port: int) -> str:
    return f"http://127.0.0.1:{port}"


def test_it_listens_on_this_machine_alone(server: Any) -> None:
    sockets = {
        line.split()[1] for line in Path("/proc/net/tcp").read_text().splitlines()[1:] if line.split()[3] == "0A"
    }
    ours = [place for place in sockets if int(place.split(":")[1], 16) == server.get_port()]
    assert ours == [f"0100007F:{server.get_port():04X}"]  # 127.0.0.1, as Linux writes it


def test_its_own_page_is_let_in(server: Any) -> None:
    with socket_of(server.get_port(), origin=own(server.get_port())) as found:
        assert len(found.recv(timeout=30)) > 0


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:1", "https://127.0.0.1", "null", None])
def test_a_websocket_from_elsewhere_is_refused(server: Any, origin: Any) -> None:
    with pytest.raises(InvalidStatus) as refused:
        socket_of(server.get_port(), origin=origin)
    assert refused.value.response.status_code == 403


def test_a_name_that_somebody_lets_point_here_is_refused(server: Any) -> None:
    def status(host: str) -> int:
        with socket.create_connection(("127.0.0.1", server.get_port())) as plain:
            plain.sendall(f"GET / HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
            return int(plain.recv(64).split()[1])

    port = server.get_port()
    assert status(f"evil.example:{port}") == 403
    assert status(f"127.0.0.1:{port}") == status(f"localhost:{port}") == 200


class Tunnel:
    """Stands where viser's tunnel does, and tells who asks for one."""

    asked = threading.Event()

    def __init__(self, *_: Any) -> None:
        self.asked.set()

    def on_disconnect(self, call: Any) -> None: ...

    def on_connect(self, call: Any) -> None: ...

    def get_status(self) -> str:
        return "failed"

    def get_url(self) -> None: ...

    def close(self) -> None: ...


def ask_for_tunnel(port: int) -> None:
    with socket_of(port, origin=own(port)) as browser:
        browser.send(msgspec.msgpack.encode({"type": "ShareUrlRequest"}))  # as its button's
        browser.send(msgspec.msgpack.encode({"type": "ShareUrlDisconnect"}))
        time.sleep(0.5)


def test_a_browser_that_asks_for_a_public_tunnel_gets_none(server: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("viser._viser.ViserTunnel", Tunnel)
    Tunnel.asked.clear()
    ask_for_tunnel(server.get_port())
    assert not Tunnel.asked.is_set()
    with pytest.raises(RuntimeError, match="no public address"):
        server.request_share_url()
    assert not Tunnel.asked.is_set()


def test_the_same_message_would_open_one_in_a_plain_server(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("viser._viser.ViserTunnel", Tunnel)
    Tunnel.asked.clear()
    with redirect_stdout(io.StringIO()):
        plain = viser.ViserServer(host="127.0.0.1", verbose=False)
    try:
        ask_for_tunnel(plain.get_port())
        assert Tunnel.asked.wait(30)
    finally:
        plain.stop()


def test_a_port_that_is_taken_is_said_and_another_found(server: Any) -> None:
    taken = server.get_port()
    with pytest.raises(ConfigError, match=f"--port: expected a free port, got {taken}"), page.serving(taken):
        pass
    with page.serving() as second:
        assert second.get_port() != taken
        assert page.address(second) == own(second.get_port())


def test_websockets_is_as_it_was_afterwards(server: Any) -> None:
    import websockets.asyncio.server as module

    assert module.serve.__module__ == module.__name__


@pytest.mark.parametrize(
    ("host", "origin", "is_socket", "is_refused"),
    [
        (["127.0.0.1:80"], [], False, False),
        (["LOCALHOST:80"], ["http://localhost:80"], True, False),
        (["127.0.0.1:80"], [], True, True),
        (["127.0.0.1:81"], [], False, True),
        ([], [], False, True),
        (["127.0.0.1:80", "evil.example"], [], False, True),
        (["127.0.0.1:80"], ["http://127.0.0.1:80", "http://evil.example"], True, True),
        (["127.0.0.1:80"], ["http://127.0.0.1:80.evil.example"], True, True),
    ],
)
def test_what_is_refused(host: list[str], origin: list[str], is_socket: bool, is_refused: bool) -> None:
    assert (page.refusal(host, origin, 80, is_socket) is not None) == is_refused


def test_no_browser_is_opened_without_a_display(server: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("webbrowser.open", lambda _: pytest.fail("a browser was opened"))
    assert not page.open_browser(server)
