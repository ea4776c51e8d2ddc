"""Access to the live map: address, token, and checks of request headers.

Any page that the operator's browser shows can send requests to this machine. So what comes must
name this very server (a name of somebody else's that leads here, DNS rebinding, does not), and must
come from its own page. Where the page commands, and on the network, a token is asked for besides:
other users and programs of this machine are not the operator.
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

# An interface's first address: netintro(4) of macOS, netdevice(7) of Linux.
_SIOCGIFADDR = 0xC0206921 if sys.platform == "darwin" else 0x8915


def reached_at(host: str) -> list[str]:
    """The addresses at which others reach a server bound to `host`: of 0.0.0.0, this machine's."""
    return (host == "0.0.0.0" and _own_addresses()) or [host]


def _own_addresses() -> list[str]:
    """This machine's IPv4 addresses, but for loopback's; needs no route and no name server."""
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        for _, name in socket.if_nameindex():
            try:
                answer = fcntl.ioctl(asking, _SIOCGIFADDR, struct.pack("256s", name.encode()))
            except OSError:
                continue  # it has none
            found.append(socket.inet_ntoa(answer[20:24]))
    return [address for address in found if not is_loopback(address)]


@dataclass(frozen=True, slots=True)
class Access:
    """`local`: bound to loopback. `token` None: none is asked for. `scheme` as in addresses."""

    local: bool
    token: str | None
    scheme: Literal["http", "https"] = "http"

    def refusal(self, host: str, origin: str | None, tokens: tuple[str | None, ...]) -> str | None:
        """Why a request is refused, or None.

        `host` and `origin` are the headers, `tokens` what it brings as such.
        """
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return "the Host header is malformed"
        if self.local and not is_loopback(name):
            return "this map is only for the laptop that it runs on"
        if origin is not None and origin != f"{self.scheme}://{host}":
            return "another page must not speak to this map"
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
