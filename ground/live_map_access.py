"""Who may see the live map, and act through it: pure rules about a request's headers.

Any page that the operator's browser shows can send requests to this machine. So what comes must
name this very server (a name of somebody else's that leads here, DNS rebinding, does not), and must
come from its own page. On the network, a token is asked for besides.
"""

import ipaddress
import secrets
from dataclasses import dataclass
from urllib.parse import urlsplit


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches a server bound to `host`."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True, slots=True)
class Access:
    """`local`: bound to loopback. `token` None: none is asked for."""

    local: bool
    token: str | None

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
        if origin is not None and origin != f"http://{host}":
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
