"""The radio's port: what is a flood, and who is kept out when."""

import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress

import pytest

from edge.core.logger import log
from edge.drivers import door, zenoh_link
from edge.drivers.door import Door, Flood
from edge.drivers.zenoh_link import ZenohLink
from edge.messages.topics import Knocking
from lpac.sim.ports import free_ports
from tests.process.drivers.test_zenoh_link import endpoint, eventually, has_peers

_ATTACHED = 26  # SO_GET_FILTER: as many bytes as the filter has instructions


class Members:
    """They knock with anything, and each knock is counted."""

    def __init__(self) -> None:
        self.knocks = 0
        self.place = ""

    def knock(self, place: str) -> bytes:
        return place.encode()

    def is_knock(self, data: bytes, place: str) -> bool:
        self.knocks += 1
        self.place = place
        return False


@pytest.fixture
def port() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening


def seen(flood: Flood, until_s: float, refused: Callable[[float], int]) -> list[bool]:
    """Looked at 20 times a second, from 100.0 s on."""
    steps = round(20 * (until_s - 100.0))
    return [flood.update(at_s, refused(at_s)) for at_s in (100.0 + n / 20 for n in range(steps))]


def test_a_fleet_that_calls_at_once_after_a_start_is_no_flood() -> None:
    assert not any(seen(Flood(100.0), 110.0, lambda at_s: min(int(20 * (at_s - 100.0)), 39)))


def test_a_flood_is_one_from_the_third_second_on_until_ten_calm_ones() -> None:
    flooded = seen(Flood(100.0), 120.0, lambda at_s: int(20 * (min(at_s, 106.0) - 100.0)))
    assert not any(flooded[:40]) and all(flooded[60:280]) and not flooded[-1]


def test_more_than_a_fleet_is_a_flood_before_that() -> None:
    """zenoh takes in each that passes, and turns them away at ten a second."""
    flooded = seen(Flood(100.0), 102.0, lambda at_s: int(1000 * (at_s - 100.0)))
    assert not any(flooded[:4]) and all(flooded[5:])


def test_a_door_that_fails_is_open(port: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever is not let in yet would be kept out for as long; even where nothing can be said."""
    monkeypatch.setattr(door, "_CALM_S", 0.2)
    failing, asked = [True], []

    def met() -> list[str]:
        asked.append(port.getsockopt(socket.SOL_SOCKET, _ATTACHED, 256))
        if failing:
            raise RuntimeError("no such thing")
        return []

    def say(*_: object, **__: object) -> None:
        raise OSError("the disk is full")

    monkeypatch.setattr(log, "error", say)
    one = Door(socket.socket(fileno=socket.dup(port.fileno())), Members(), met)
    try:
        eventually(lambda: not port.getsockopt(socket.SOL_SOCKET, _ATTACHED, 256))
        failing.clear()
        eventually(lambda: len(port.getsockopt(socket.SOL_SOCKET, _ATTACHED, 256)) > 0)
        assert all(asked), "it is watched behind its filter"
    finally:
        one.close()


def test_knocks_beyond_the_rate_wait_their_turn(port: socket.socket) -> None:
    members = Members()
    one = Door(socket.socket(fileno=socket.dup(port.fileno())), members, list)

    def knock(so_far: int) -> None:
        for _ in range(100):
            stranger.sendto(b"knock", port.getsockname())
        eventually(lambda: members.knocks == so_far)

    with closing(one), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for so_far in range(100, 700, 100):
            knock(so_far)
    assert members.place == "127.0.0.1:{1}".format(*port.getsockname())


def test_with_scouting_the_port_is_open_to_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Members that only found this one know no port to knock at."""
    asked: list[Knocking | None] = []

    def open_behind(_: object, members: Knocking | None) -> None:
        asked.append(members)
        raise zenoh_link.LinkError("not here")

    monkeypatch.setattr(zenoh_link, "_open_with_doors", open_behind)
    with pytest.raises(zenoh_link.LinkError, match="not here"):
        ZenohLink(fleet="demo", scouting=True, members=Members())
    assert asked == [None]


def test_a_member_knocks_at_each_port_of_an_address(
    port: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of robots that share a computer it is connected to one; the other is not there yet."""
    monkeypatch.setattr(zenoh_link, "is_loopback", lambda _: False)
    monkeypatch.setattr(zenoh_link, "_open_with_doors", lambda c, _: (zenoh_link._open(c), []))
    there = endpoint()
    absent = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    with (
        ExitStack() as sockets,
        ZenohLink(fleet="demo", listen=[there]),
        ZenohLink(fleet="demo", connect=[there, absent], members=Members()) as link,
    ):

        def knocks_at(place: str) -> socket.socket:
            one = sockets.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            one.bind(("127.0.0.1", int(place.rpartition(":")[2])))
            one.settimeout(60.0)
            return one

        met, missed = knocks_at(there), knocks_at(absent)
        eventually(lambda: has_peers(link, 1))
        missed.settimeout(0.0)
        with suppress(BlockingIOError):
            while missed.recv(100):
                pass
        missed.settimeout(60.0)
        # A round that began before the connection did may end after it.
        for _ in range(2):
            assert missed.recv(100) == absent.removeprefix("tcp/").encode()
        met.settimeout(0.0)
        with suppress(BlockingIOError):
            while met.recv(100):
                pass
        for _ in range(2):
            assert missed.recv(100) == absent.removeprefix("tcp/").encode()
        with pytest.raises(BlockingIOError):
            met.recv(100)
