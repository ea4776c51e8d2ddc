"""Addresses have one reading: what C would read in another way is refused."""

import pytest

from edge.core.address import (
    host_and_port,
    ipv4,
    is_loopback,
    is_loopback_endpoint,
    require_endpoint,
    require_host,
    same_host,
)

# What inet_aton takes for an address of four numbers, or int() for numbers; and nearly addresses.
LOOK_LIKE_ADDRESSES = (
    "192.168.8.011", "0192.168.8.11", "10.1", "10", "0x7f000001", "0x7f.1", "192.168.8.256",
    "192.168.8.9.", "192.168..9", "192.168.8.0.9", "::1::", "::ffff:192.168.8.011", "1:2",
)  # fmt: skip
# Arabic-Indic, fullwidth and Devanagari.
OTHER_DIGITS = ("192.168.8.\u0669", "\uff11\uff10.0.0.1", "\u0967")


@pytest.mark.parametrize("host", LOOK_LIKE_ADDRESSES)
def test_a_host_that_looks_like_an_address_but_is_none_is_refused(host: str) -> None:
    with pytest.raises(ValueError, match=r"^host = .*: looks like an address, but is none: must"):
        require_host("host", host)
    assert ipv4(host) is None


@pytest.mark.parametrize("host", (*OTHER_DIGITS, "", "-x", "a b", "a/b", "192.168.8.9 "))
def test_a_host_is_of_plain_letters_and_digits(host: str) -> None:
    with pytest.raises(ValueError, match=r"^host = .*: must be letters, digits"):
        require_host("host", host)
    assert ipv4(host) is None


@pytest.mark.parametrize(
    "host", ["192.168.8.11", "::1", "fe80::1", "drone12", "r2.local", "drone.1", "1a", "_a"]
)
def test_addresses_and_names_are_hosts(host: str) -> None:
    require_host("host", host)


def test_an_address_is_the_same_however_it_is_spelled() -> None:
    assert same_host("fe80:0::1") == same_host("fe80::1") == "fe80::1"
    assert same_host("::ffff:192.168.8.9") == same_host("192.168.8.9") == "192.168.8.9"
    assert same_host("drone12") == "drone12"


def test_endpoints_have_a_host_and_a_port() -> None:
    for endpoint in ("tcp/192.168.8.9:7447", "tcp/[::1]:0", "tcp/drone12:65535"):
        require_endpoint("listen", endpoint, "tls", "tcp")
    for endpoint in (
        "tls/10.0.0.1:1", "tcp/10.0.0.1", "tcp/10.0.0.1:65536", "tcp/::1:7447", "tcp/[10.0.0.1]:1",
        "tcp/10.0.0.1:\u0667", "10.0.0.1:7447", "tcp/:7447",
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"^listen = .*: must be tcp/ADDRESS:PORT$"):
            require_endpoint("listen", endpoint, "tcp")
    with pytest.raises(ValueError, match=r"^listen = '127.0.0.011': looks like"):
        require_endpoint("listen", "tcp/127.0.0.011:7447", "tcp")
    assert host_and_port("listen", "[::1]:7447") == ("::1", 7447)
    assert host_and_port("listen", "auto") is None


def test_what_is_out_of_other_computers_reach() -> None:
    assert all(map(is_loopback, ("127.0.0.1", "127.1.2.3", "::1", "localhost")))
    assert not any(map(is_loopback, ("0.0.0.0", "192.168.8.9", "127.evil.example", "127.0.0.011")))
    assert is_loopback_endpoint("tcp/[::1]:7447") and is_loopback_endpoint("tls/127.0.0.1:1")
    assert not is_loopback_endpoint("tcp/127.evil.example:7447")
