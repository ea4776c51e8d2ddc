"""Access to the live map: address, token, and checks of request headers.

Any page in the operator's browser can send requests to this machine. So a request's Host must be
this server (against DNS rebinding), and its Origin this server's own page. A map that can command,
or is on the network, also requires a token, since other users of this machine are not the operator.
"""

import fcntl
import secrets
import socket
import struct
import sys
from dataclasses import dataclass
from typing import Literal
from urllib.parse import urlsplit

from edge.core.address import is_loopback

# Reads an interface's first address: netintro(4) of macOS, netdevice(7) of Linux.
_SIOCGIFADDR = 0xC0206921 if sys.platform == "darwin" else 0x8915


def server_addresses(host: str) -> list[str]:
    """Addresses of a server bound to `host`; for 0.0.0.0, those of this machine."""
    return (host == "0.0.0.0" and _own_addresses()) or [host]


def _own_addresses() -> list[str]:
    """This machine's IPv4 addresses without loopback; needs no route and no name server."""
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        for _, name in socket.if_nameindex():
            try:
                answer = fcntl.ioctl(asking, _SIOCGIFADDR, struct.pack("256s", name.encode()))
            except OSError:
                continue  # no IPv4 address
            found.append(socket.inet_ntoa(answer[20:24]))
    return [address for address in found if not is_loopback(address)]


@dataclass(frozen=True, slots=True)
class Access:
    """`local`: bound to loopback. `token`: required from requests, if not None."""

    local: bool
    token: str | None
    scheme: Literal["http", "https"] = "http"

    def refusal(self, host: str, origin: str | None, tokens: tuple[str | None, ...]) -> str | None:
        """Why a request is refused, or None.

        `host` and `origin` are its headers, `tokens` those in its cookie and query.
        """
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return "the Host header is malformed"
        if self.local and not is_loopback(name):
            return "this map only serves the laptop that it runs on"
        if origin is not None and origin != f"{self.scheme}://{host}":
            return "requests from other pages are refused"
        if self.token is not None and not self._knows(tokens):
            return "the token is missing or wrong: open the address that `lpac map` printed"
        return None

    def _knows(self, tokens: tuple[str | None, ...]) -> bool:
        assert self.token is not None
        wanted = self.token.encode()
        return any(
            secrets.compare_digest(given.encode(errors="replace"), wanted)
            for given in tokens
            if given is not None
        )
