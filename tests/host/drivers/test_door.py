"""The radio's port under floods of strange connections, in networks that the test makes itself."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from threading import Thread
from typing import Self

import pytest

from edge.identity.card import Role
from lpac.fleet.authority import create_authority, new_member
from tests.needs import needs

pytestmark = needs("ip", root=True)

ROBOT, GROUND, STRANGER = "10.213.0.1", "10.213.0.2", "10.213.0.3"
PORT = 7447
PATIENCE_S = 30.0
# A flood ends by itself, whatever becomes of the test.
LONGEST_S = 120.0

_COMMON = """
import sys, time
from pathlib import Path
from edge.drivers.door import allow_most_descriptors
from edge.drivers.identity_folder import load_identity
from edge.drivers.zenoh_link import ZenohLink, ZenohRouter
from edge.messages.topics import GROUND_CARD, STATUS
keys, *arguments = sys.argv[1:]
identity = load_identity(Path(keys), fleet="demo", unix_s=time.time())
guard = identity.guard(time.monotonic)
settings = dict(fleet="demo", tls=identity.tls, members=guard)
"""
_ROBOT = """
allow_most_descriptors()
with ZenohLink(robot_id=1, listen=["tls/0.0.0.0:7447"], **settings) as link:
    while True:
        link.publish(STATUS, b"here")
        [door] = link.doors()
        print("flooded" if door.flooded else "calm", flush=True)
        time.sleep(0.1)
"""
_ROUTER = """
with ZenohRouter(listen=["tls/0.0.0.0:7447"], **settings):
    while True:
        print("calm", flush=True)
        time.sleep(0.1)
"""
_MEMBER = """
mode, robot_id = arguments
with ZenohLink(
    mode=mode, robot_id=int(robot_id) if robot_id else None, connect=["tls/10.213.0.1:7447"],
    subscriptions={STATUS: lambda *_: print("heard", flush=True)}, **settings,
) as link:
    while True:
        link.publish(STATUS if robot_id else GROUND_CARD, b"here")
        time.sleep(0.1)
"""
_FLOOD = """
import socket, sys, time
kind, rate_hz, longest_s = sys.argv[1], float(sys.argv[2]), float(sys.argv[3])
began_s, called, calls = time.monotonic(), 0, []
print("floods", flush=True)
while time.monotonic() - began_s < longest_s:
    while called < (time.monotonic() - began_s) * rate_hz:
        called += 1
        call = socket.socket()
        call.setblocking(False)
        call.connect_ex(("10.213.0.1", 7447))
        calls.append((time.monotonic(), call))
    while calls and time.monotonic() - calls[0][0] > 0.02:
        if kind == "idle" and len(calls) <= 1500:
            break
        _, call = calls.pop(0)
        try:
            call.send(b"GET / HTTP/1.0\\r\\n\\r\\n")
        except OSError:
            pass
        call.close()
    time.sleep(0.001)
"""


_LEFT_ALONE = """
import sys
from edge.drivers.px4 import left_alone
print("listens", flush=True)
left_alone.main()
"""
_VEHICLE = """
import socket, sys, time
from tests.process.drivers.test_watchdog import HOLD, beat
udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
udp.settimeout(0.2)
while True:
    udp.sendto(beat(7, HOLD), (sys.argv[1], 14551))
    try:
        udp.recv(300)
        print("told to land", flush=True)
    except OSError:
        print("told nothing", flush=True)
"""


class Program:
    """A Python program in one of the networks, and the lines that it prints."""

    def __init__(self, network: str, script: str, *arguments: str) -> None:
        self._process = subprocess.Popen(
            ["ip", "netns", "exec", network, sys.executable, "-c", script, *arguments],
            stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[3],
        )  # fmt: skip
        self.lines: list[str] = []
        self._reader = Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.lines.append(line.strip())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        self._reader.join()
        assert self._process.stdout is not None
        self._process.stdout.close()

    def signal(self, number: int) -> None:
        self._process.send_signal(number)

    def says(self, line: str) -> None:
        """It says so once more, from now on."""
        before = len(self.lines)
        until_s = time.monotonic() + PATIENCE_S
        while line not in self.lines[before:]:
            assert time.monotonic() < until_s and self._process.poll() is None, self.lines[-3:]
            time.sleep(0.02)


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


@pytest.fixture
def air() -> Iterator[Callable[[str], str]]:
    """Three computers on one network: the name of each one's namespace."""
    with ExitStack() as made:

        def name(of: str) -> str:
            return f"lpac-door-{os.getpid()}-{of}"

        def add(of: str) -> None:
            ip("netns", "add", name(of))
            made.callback(ip, "netns", "del", name(of))
            ip("-n", name(of), "link", "set", "lo", "up")

        add("air")
        ip("-n", name("air"), "link", "add", "name", "bridge0", "type", "bridge")
        ip("-n", name("air"), "link", "set", "bridge0", "up")
        for address in (ROBOT, GROUND, STRANGER):
            add(address)
            port = f"to{address[-1]}"
            ip("link", "add", port, "netns", name("air"), "type", "veth",
               "peer", "name", "wlan0", "netns", name(address))  # fmt: skip
            ip("-n", name("air"), "link", "set", port, "master", "bridge0", "up")
            ip("-n", name(address), "address", "add", f"{address}/24", "dev", "wlan0")
            ip("-n", name(address), "link", "set", "wlan0", "up")
        yield name


@pytest.fixture
def keys(tmp_path: Path) -> Callable[[str], str]:
    authority = create_authority(tmp_path / "authority", "demo")
    for robot_id in (1, 2):
        new_member(authority, tmp_path / f"r{robot_id}", Role.ROBOT, f"r{robot_id}", robot_id)
    new_member(authority, tmp_path / "ground", Role.OPERATOR, "alice")
    return lambda name: str(tmp_path / name)


@pytest.mark.parametrize(
    ("kind", "rate_hz"), [("junk", 20), ("junk", 200), ("junk", 2000), ("idle", 500)]
)
def test_members_come_in_while_strangers_flood_a_robots_port(
    kind: str, rate_hz: int, air: Callable[[str], str], keys: Callable[[str], str]
) -> None:
    """One that was never there, one that stalled, that started again, whose network was gone."""
    with ExitStack() as programs:

        def start(at: str, script: str, *arguments: str) -> Program:
            return programs.enter_context(Program(air(at), script, *arguments))

        robot = start(ROBOT, _COMMON + _ROBOT, keys("r1"))
        robot.says("calm")
        start(STRANGER, _FLOOD, kind, str(rate_hz), str(LONGEST_S)).says("floods")
        robot.says("flooded")
        ground = start(GROUND, _COMMON + _MEMBER, keys("ground"), "peer", "")
        ground.says("heard")
        # Longer than the lease.
        ground.signal(signal.SIGSTOP)
        time.sleep(3.0)
        ground.signal(signal.SIGCONT)
        ground.says("heard")
        ground.__exit__()
        ground = start(GROUND, _COMMON + _MEMBER, keys("ground"), "peer", "")
        ground.says("heard")
        ip("-n", air("air"), "link", "set", "to2", "down")
        time.sleep(3.0)
        before = len(ground.lines)
        ip("-n", air("air"), "link", "set", "to2", "up")
        ground.says("heard")
        assert len(ground.lines) > before
        robot.__exit__()
        start(ROBOT, _COMMON + _ROBOT, keys("r1"))
        ground.says("heard")


@pytest.mark.parametrize("rate_hz", [20, 2000])
def test_members_come_in_while_strangers_flood_the_router(
    rate_hz: int, air: Callable[[str], str], keys: Callable[[str], str]
) -> None:
    """As where robots speak by multicast, and to the ground by way of the router."""
    with ExitStack() as programs:

        def start(at: str, script: str, *arguments: str) -> Program:
            return programs.enter_context(Program(air(at), script, *arguments))

        start(ROBOT, _COMMON + _ROUTER, keys("ground")).says("calm")
        start(STRANGER, _FLOOD, "junk", str(rate_hz), str(LONGEST_S)).says("floods")
        time.sleep(1.0)
        start(GROUND, _COMMON + _MEMBER, keys("r2"), "client", "2")
        ground = start(GROUND, _COMMON + _MEMBER, keys("ground"), "client", "")
        ground.says("heard")


def test_strangers_come_in_again_when_the_flood_is_over(
    air: Callable[[str], str], keys: Callable[[str], str]
) -> None:
    """As a member that cannot knock does: seldom, but in time."""
    with Program(air(ROBOT), _COMMON + _ROBOT, keys("r1")) as robot:
        robot.says("calm")
        with Program(air(STRANGER), _FLOOD, "junk", "100", str(LONGEST_S)) as flood:
            flood.says("floods")
            robot.says("flooded")
        robot.says("calm")
        silent = _COMMON.replace("members=guard", "members=None") + _MEMBER
        with Program(air(GROUND), silent, keys("ground"), "peer", "") as ground:
            until_s = time.monotonic() + 4 * PATIENCE_S
            while not ground.lines:
                assert time.monotonic() < until_s
                time.sleep(0.1)


def test_no_stranger_speaks_for_a_vehicle_that_was_left_alone(
    air: Callable[[str], str], tmp_path: Path
) -> None:
    toml = tmp_path / "robot.toml"
    url = "udpin://127.0.0.1:14551"
    toml.write_text(f'[autopilot]\nurl = "{url}"\nsystem_id = 7\n[flight]\nhover_land_s = 0.0\n')
    with Program(air(ROBOT), _LEFT_ALONE, str(toml)) as alone:
        alone.says("listens")
        with Program(air(STRANGER), _VEHICLE, ROBOT) as stranger:
            for _ in range(5):
                stranger.says("told nothing")
            with Program(air(ROBOT), _VEHICLE, "127.0.0.1") as vehicle:
                vehicle.says("told to land")
            assert "told to land" not in stranger.lines
