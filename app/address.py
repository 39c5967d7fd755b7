"""Where a source of clouds is: a folder, or a place of OpenIGTLink (`igtl://HOST:PORT`)."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import parse_qsl, urlsplit

from .config import ConfigError

SCHEME = "igtl"
PORT = 18944  # that OpenIGTLink programs take where nothing is said
_FORMS = "igtl://HOST:PORT, igtl://:PORT or igtl://:PORT?bind=HOST, with device=NAME behind ? if only that one is meant"


@dataclass(frozen=True)
class Address:
    """A place of OpenIGTLink.

    Args:
        host: to connect to; where it listens, the address of this machine that it does so on, 127.0.0.1 if empty.
        port: of it.
        is_server: whether to listen.
        device: name of the device whose clouds are meant; empty for any.
    """

    host: str
    port: int
    is_server: bool = False
    device: str = ""

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        asked = [
            f"bind={self.host}" if self.is_server and self.host else "",
            f"device={self.device}" if self.device else "",
        ]
        words = "&".join(filter(None, asked))
        return f"{SCHEME}://{'' if self.is_server else host}:{self.port}{'?' if words else ''}{words}"

    def at(self, port: int | None = None) -> str:
        """Host and port for a person.

        Args:
            port: in place of its own.
        """
        return f"{self.host or '127.0.0.1'}:{self.port if port is None else port}"

    @property
    def warning(self) -> str:
        """What a person is to know of a port that others than this machine reach; empty otherwise."""
        try:
            is_open = not ipaddress.ip_address(self.host or "127.0.0.1").is_loopback
        except ValueError:
            is_open = self.host != "localhost"
        return "; whoever reaches it can send and listen: OpenIGTLink has no password" if is_open else ""


def parse_source(text: str) -> Path | Address:
    """What a person means by a source: a folder, or `igtl://...`.

    Args:
        text: as it was typed.

    Raises:
        ConfigError: another scheme, no port, or words that are not known.
    """
    scheme, separator, _ = text.partition("://")
    if not separator:
        return Path(text)
    if scheme != SCHEME:
        raise ConfigError(f"source: expected a folder or {_FORMS}, got {text!r}.")
    return _address(text)


def _address(text: str) -> Address:
    try:
        parts = urlsplit(text)
        host, port = parts.hostname or "", PORT if parts.port is None else parts.port
    except ValueError as error:
        raise ConfigError(f"source: expected {_FORMS}, got {text!r} ({error}).") from None
    asked = dict(parse_qsl(parts.query, keep_blank_values=True))
    unknown = sorted(asked.keys() - {"device", "bind"})
    if unknown or parts.path.strip("/") or parts.username or not all(asked.values()) or ("bind" in asked and host):
        raise ConfigError(f"source: expected {_FORMS}, got {text!r}.")
    return Address(asked.get("bind", host), port, not host, asked.get("device", ""))
