"""The radio's port under floods of strange connections, in networks that the test makes itself."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from threading import Thread
from typing import NamedTuple, Self

import pytest

from edge.identity.members import Role
from lpac.fleet.authority import create_authority, new_member
from lpac.sim.fleet.keys import give_list
from tests.needs import needs

pytestmark = needs("ip", root=True)

ROBOT, GROUND, STRANGER, OTHER = "10.213.0.1", "10.213.0.2", "10.213.0.3", "10.213.0.4"
PORT = 7447
PATIENCE_S = 30.0
# A flood ends by itself, whatever becomes of the test.
LONGEST_S = 120.0

_COMMON = """
import sys, time
from pathlib import Path
from edge.drivers.door import allow_most_descriptors
from edge.drivers.identity_folder import load_identity
from edge.drivers.zenoh_link import ZenohLink
from edge.messages.topics import HOLD, STATUS
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
_MEMBER = """
robot_id, *listen = arguments
with ZenohLink(
    robot_id=int(robot_id) if robot_id else None, listen=listen, connect=["tls/10.213.0.1:7447"],
    subscriptions={STATUS: lambda key, _: print("heard", key.split("/")[1], flush=True)},
    **settings,
) as link:
    while True:
        link.publish(STATUS if robot_id else HOLD, b"here")
        time.sleep(0.1)
"""
_FLOOD = """
import socket, sys, time
address, kind, rate_hz, longest_s = *sys.argv[1:3], float(sys.argv[3]), float(sys.argv[4])
began_s, called, calls = time.monotonic(), 0, []
print("floods", flush=True)
while time.monotonic() - began_s < longest_s:
    while called < (time.monotonic() - began_s) * rate_hz:
        called += 1
        call = socket.socket()
        call.setblocking(False)
        call.connect_ex((address, 7447))
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


_UNATTENDED = """
import sys
from edge.drivers.px4 import unattended
print("listens", flush=True)
unattended.main()
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


class Air(NamedTuple):
    """Four computers on one network, and their identities: the folder of each one's keys."""

    number: int
    keys: Path

    def name(self, of: str) -> str:
        """Its namespace."""
        return f"lpac-door-{os.getpid()}-{self.number}-{of}"

    def link(self, of: str, state: str) -> None:
        ip("-n", self.name("air"), "link", "set", f"to{of[-1]}", state)

    def start(self, at: str, script: str, *arguments: str) -> Program:
        return Program(self.name(at), script, *arguments)

    def member(self, at: str, *listen: str, script: str = _COMMON + _MEMBER) -> Program:
        """The ground's at GROUND; elsewhere robot 2's."""
        who, robot_id = ("ground", "") if at == GROUND else ("r2", "2")
        return self.start(at, script, str(self.keys / who), robot_id, *listen)

    def robot(self) -> Program:
        return self.start(ROBOT, _COMMON + _ROBOT, str(self.keys / "r1"))

    def flood(self, kind: str, rate_hz: int, address: str = ROBOT) -> Program:
        return self.start(STRANGER, _FLOOD, address, kind, str(rate_hz), str(LONGEST_S))


@pytest.fixture
def airs(tmp_path: Path) -> Iterator[Callable[[], Air]]:
    """Makes one more that has nothing to do with the others."""
    with ExitStack() as made:

        def add(air: Air, of: str) -> str:
            ip("netns", "add", air.name(of))
            made.callback(ip, "netns", "del", air.name(of))
            ip("-n", air.name(of), "link", "set", "lo", "up")
            return air.name(of)

        def make() -> Air:
            number = len(list(tmp_path.iterdir()))
            air = Air(number, tmp_path / str(number))
            bridge = add(air, "air")
            ip("-n", bridge, "link", "add", "name", "bridge0", "type", "bridge")
            ip("-n", bridge, "link", "set", "bridge0", "up")
            for address in (ROBOT, GROUND, STRANGER, OTHER):
                port, computer = f"to{address[-1]}", add(air, address)
                ip("-n", bridge, "link", "add", port, "type", "veth",
                   "peer", "name", "wlan0", "netns", computer)  # fmt: skip
                ip("-n", bridge, "link", "set", port, "master", "bridge0", "up")
                ip("-n", computer, "address", "add", f"{address}/24", "dev", "wlan0")
                ip("-n", computer, "link", "set", "wlan0", "up")
            authority = create_authority(air.keys / "authority", "demo")
            for robot_id in (1, 2):
                new_member(
                    authority, air.keys / f"r{robot_id}", Role.ROBOT, f"r{robot_id}", robot_id
                )
            new_member(authority, air.keys / "ground", Role.OPERATOR, "alice")
            give_list(authority, *(air.keys / name for name in ("r1", "r2", "ground")))
            return air

        yield make


def test_members_come_in_while_strangers_flood(airs: Callable[[], Air]) -> None:
    """Several floods at once, each on a network of its own: what takes long is waiting."""
    floods: list[tuple[Callable[..., None], tuple[object, ...]]] = [
        (members_come_in_to_a_robot, ("junk", 20)),
        (members_come_in_to_a_robot, ("junk", 200)),
        (members_come_in_to_a_robot, ("junk", 2000)),
        (members_come_in_to_a_robot, ("idle", 500)),
        (a_ground_connects_though_its_own_port_is_flooded, (20,)),
        (a_ground_connects_though_its_own_port_is_flooded, (2000,)),
        (strangers_come_in_again_when_the_flood_is_over, ()),
    ]
    with ThreadPoolExecutor(3) as pool:
        running = [pool.submit(case, airs(), *flood) for case, flood in floods]
    for done in running:
        done.result()


def members_come_in_to_a_robot(air: Air, kind: str, rate_hz: int) -> None:
    """One that was never there, one that stalled, that started again, whose network was gone."""
    with ExitStack() as programs:
        robot = programs.enter_context(air.robot())
        robot.says("calm")
        programs.enter_context(air.flood(kind, rate_hz)).says("floods")
        robot.says("flooded")
        ground = programs.enter_context(air.member(GROUND))
        other = programs.enter_context(air.member(OTHER))
        ground.says("heard 1")
        other.says("heard 1")
        ground.signal(signal.SIGSTOP)
        air.link(OTHER, "down")
        time.sleep(3.0)  # longer than the lease
        air.link(OTHER, "up")
        other.says("heard 1")
        ground.signal(signal.SIGCONT)
        ground.says("heard 1")
        ground.__exit__()
        ground = programs.enter_context(air.member(GROUND))
        ground.says("heard 1")
        robot.__exit__()
        programs.enter_context(air.robot())
        ground.says("heard 1")
        other.says("heard 1")


def a_ground_connects_though_its_own_port_is_flooded(air: Air, rate_hz: int) -> None:
    """To a robot that starts again, too."""
    with ExitStack() as programs:
        robot = programs.enter_context(air.robot())
        robot.says("calm")
        ground = programs.enter_context(air.member(GROUND, f"tls/0.0.0.0:{PORT}"))
        ground.says("heard 1")
        programs.enter_context(air.flood("junk", rate_hz, GROUND)).says("floods")
        time.sleep(1.0)
        ground.says("heard 1")
        robot.__exit__()
        programs.enter_context(air.robot())
        ground.says("heard 1")


def strangers_come_in_again_when_the_flood_is_over(air: Air) -> None:
    """As a member that cannot knock does: seldom, but in time."""
    with air.robot() as robot:
        robot.says("calm")
        with air.flood("junk", 100) as flood:
            flood.says("floods")
            robot.says("flooded")
        robot.says("calm")
        silent = _COMMON.replace("members=guard", "members=None") + _MEMBER
        with air.member(GROUND, script=silent) as ground:
            until_s = time.monotonic() + 4 * PATIENCE_S
            while not ground.lines:
                assert time.monotonic() < until_s
                time.sleep(0.1)


def test_no_stranger_speaks_for_a_vehicle_that_was_left_alone(
    airs: Callable[[], Air], tmp_path: Path
) -> None:
    air = airs()
    toml = tmp_path / "robot.toml"
    url = "udpin://127.0.0.1:14551"
    toml.write_text(f'[autopilot]\nurl = "{url}"\nsystem_id = 7\n[flight]\nhover_land_s = 0.0\n')
    with air.start(ROBOT, _UNATTENDED, str(toml)) as alone:
        alone.says("listens")
        with air.start(STRANGER, _VEHICLE, ROBOT) as stranger:
            for _ in range(5):
                stranger.says("told nothing")
            with air.start(ROBOT, _VEHICLE, "127.0.0.1") as vehicle:
                vehicle.says("told to land")
            assert "told to land" not in stranger.lines
