"""Parses hosts, addresses and endpoints in configurations.

Addresses are read as by Python's `ipaddress`. C's inet_aton, used by ssh, ping and zenoh, has other
readings: 192.168.8.011 is octal for 192.168.8.9, and 10.1 is 10.0.0.1; and int() accepts digits of
other scripts. Check every address here before it is used.
"""

import ipaddress
import re

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
# Labels that inet_aton reads as numbers: 10.1, 0x7f000001, 192.168.8.9; or none.
_NUMBERS = re.compile(r"(0[xX][0-9A-Fa-f]*|[0-9]*)(\.(0[xX][0-9A-Fa-f]*|[0-9]*))*")
_PLACE = re.compile(r"(\[(?P<ipv6>[^\[\]]*:[^\[\]]*)\]|(?P<host>[^:\[\]]+)):(?P<port>[0-9]{1,5})")


def ipv4(text: str) -> ipaddress.IPv4Address | None:
    """Parse an IPv4 address; None if it is invalid."""
    try:
        return ipaddress.IPv4Address(text)
    except ValueError:
        return None


def same_host(host: str) -> str:
    """Normalise the spelling of an address; names stay unchanged."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return str(mapped or address)


def require_host(key: str, host: str) -> None:
    """Raise ValueError, one line, unless `host` is an IPv4 or IPv6 address or a name."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        if host and (":" in host or _NUMBERS.fullmatch(host)):
            raise ValueError(
                f"{key} = {host!r}: looks like an address, but is none: must be four numbers from "
                "0 to 255 without leading zeros, such as '192.168.8.11', an IPv6 address, or a name"
            ) from None
        if _NAME.fullmatch(host) is None:
            raise ValueError(
                f"{key} = {host!r}: must be letters, digits, '.', '-' and '_', and not start with "
                "'.' or '-'"
            ) from None


def host_and_port(key: str, place: str) -> tuple[str, int] | None:
    """Split HOST:PORT, with an IPv6 address in brackets; None for another form.

    Raises ValueError, one line, for an invalid host.
    """
    match = _PLACE.fullmatch(place)
    if match is None or int(match["port"]) > 65535:
        return None
    host = match["ipv6"] or match["host"]
    require_host(key, host)
    return host, int(match["port"])


def require_endpoint(key: str, endpoint: str, *schemes: str) -> None:
    """Raise ValueError, one line, unless `endpoint` is SCHEME/HOST:PORT with one of the schemes."""
    scheme, _, place = endpoint.partition("/")
    if scheme not in schemes or host_and_port(key, place) is None:
        forms = ", or ".join(f"{scheme}/ADDRESS:PORT" for scheme in schemes)
        raise ValueError(f"{key} = {endpoint!r}: must be {forms}")


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a server bound to `host`."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def is_loopback_endpoint(endpoint: str) -> bool:
    """Whether only this machine can reach an endpoint such as tcp/127.0.0.1:7447."""
    return is_loopback(endpoint.partition("/")[2].rpartition(":")[0].strip("[]"))
