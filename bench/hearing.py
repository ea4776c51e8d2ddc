"""What it takes a robot to hear the others: 9, or 99, that say as much as in flight, by multicast.

The robot is a program's node with its guard and its link. Its own steps do not run, so that all
that its process takes is hearing: datagrams, signatures, decoding, mail. The others are one process
that says, in all their names, what robots of a simulated flight said.
"""

import itertools
import socket
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from bench import BUNDLE
from bench.result import Result, Table, Target, progress
from edge.core.aggregation import AggregatedMessage
from edge.core.logger import show
from edge.core.wire import PayloadType, decode, encode, payload_type_of
from edge.drivers.multicast import MulticastLink
from edge.drivers.registry import load_policy
from edge.drivers.zenoh_link import ZenohLink
from edge.identity.card import Role
from edge.identity.group import GroupKey, datagrams, number_in
from edge.identity.guard import Speaker
from edge.identity.news import MessageNumber
from edge.messages.beacon import BEACON_BYTES, Beacon, decode_beacon, encode_beacon
from edge.messages.topics import MESSAGE, Group, Link, Topic
from edge.policy.bundle import load_bundle
from lpac.ground.station.protocol import Enable, SetOrigin, Start, Takeoff
from lpac.sim.fleet.layout import ORIGIN
from lpac.sim.fleet.members import SimulatedMembers
from lpac.sim.fleet.simulated import EPOCH_S, SimulatedFleet
from lpac.sim.ports import free_ports
from lpac.sim.scenario import Scenario

_FLEET, _SEED = "simulated", 1
_KEY = b"h" * 32
# After each command robots of the simulated flight are ready for the next, and have seen something
# after the last; and how long until the others know that somebody is there, s.
_FLOWN_S, _WARM_UP_S = 15.0, 3.0
# Programs that began after those of the flight.
_START = int(1e3 * (EPOCH_S + 3600.0))


@dataclass(frozen=True, slots=True)
class Heard:
    """One robot among `others`: messages a second, the share that it took, percent of a core."""

    others: int
    messages_hz: float
    taken: float
    cpu_percent: float


def measure(
    others: tuple[int, ...] = (0, 9, 99), seconds: float = 20.0, robots: int = 10
) -> Result:
    """Each number of others in turn; they say what so many robots of a flight said."""
    heard: list[Heard] = []
    for count in others:
        progress(f"hearing: {count} others, {seconds:g} s")
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as alone:
            heard.append(alone.submit(_hear, count, seconds, robots).result())
    by_count = {each.others: each for each in heard}
    idle = by_count[0].cpu_percent if 0 in by_count else 0.0
    rows = []
    for each in heard:
        own = each.cpu_percent - idle
        cost_us = 1e4 * own / each.messages_hz if each.messages_hz else 0.0
        rows.append(
            (
                f"{each.others}", f"{each.messages_hz:.1f}", f"{100.0 * each.taken:.1f}",
                f"{each.cpu_percent:.2f}", f"{cost_us:.0f}" if each.messages_hz else "",
            )
        )  # fmt: skip
    return Result(
        "hearing",
        {str(each.others): asdict(each) for each in heard},
        [
            Table(
                "A robot that hears others by multicast",
                ("others", "messages, 1/s", "taken, %", "% of a core", "us a message"),
                rows,
            )
        ],
        [
            Target(f"{count} others, % of a core", by_count[count].cpu_percent, limit, False)
            for count, limit in ((9, 3.0), (99, 6.0))
            if count in by_count
        ],
        ["Us a message are those above what it takes with nobody there."],
    )


def _hear(others: int, seconds: float, robots: int) -> Heard:
    """In a process of its own, so that nothing else is counted."""
    show("error")
    port, zenoh_port = free_ports(2)
    group = Group("239.255.76.90", port, "127.0.0.1", (_KEY,), is_secret=True)
    with tempfile.TemporaryDirectory() as folder:
        fleet = SimulatedFleet(
            Scenario(robots=robots, seed=_SEED, secure=True), Path(folder), BUNDLE
        )
        said = _messages_of(fleet)
        node = fleet.robots[0].node
        assert node is not None
        link = MulticastLink(
            group,
            robot_id=0,
            subscriptions=node.subscriptions,
            zenoh=ZenohLink(
                fleet=_FLEET, robot_id=0, listen=[f"tcp/127.0.0.1:{zenoh_port}"],
                scouting=False, subscriptions={},
            ),
        )  # fmt: skip
        with link, _Others(group, others, said) as speaking:
            time.sleep(_WARM_UP_S)
            before, sent_before = _taken(fleet), speaking.sent
            began_s, cpu_s = time.monotonic(), time.process_time()
            time.sleep(seconds)
            cpu_s, took_s = time.process_time() - cpu_s, time.monotonic() - began_s
            sent, taken = speaking.sent - sent_before, _taken(fleet) - before
        fleet.close()
    return Heard(others, sent / took_s, taken / sent if sent else 1.0, 100.0 * cpu_s / took_s)


def _taken(fleet: SimulatedFleet) -> int:
    """How many of the others' messages the first robot's policy has got."""
    node = fleet.robots[0].node
    assert node is not None
    return node.status_step({}).message_counts["accepted"]


def _messages_of(fleet: SimulatedFleet) -> "list[_Said]":
    """What robots say in the mission, newest last: the clock stands still from then on."""
    policy, listener = load_policy(fleet.layout.bundle), len(fleet.robots)
    perception = fleet.layout.bundle.manifest.perception
    assert perception
    said: list[_Said] = []

    def hear(_: str, data: bytes, __: Speaker) -> None:
        body = data[BEACON_BYTES:]
        message = decode(
            body,
            bundle_id=policy.bundle_id, frame_id=None,
            message_size=policy.message_size, shared_side=perception.shared_map_side,
        )  # fmt: skip
        if isinstance(message, AggregatedMessage):
            said.append(_Said(decode_beacon(data), message, payload_type_of(body)))

    assert fleet.members is not None
    guard = fleet.members.guard(
        Role.ROBOT, "listener", listener, _START, fleet.schedule.monotonic_s
    )
    fleet.radio.link(listener, guard.subscriptions({MESSAGE: hear}))
    fleet.schedule.run_until(_FLOWN_S)
    for request in (SetOrigin(ORIGIN), Enable(), Takeoff(), Start()):
        report = fleet.ground.command(request)
        if not report.done:
            raise RuntimeError(f"the flight did not go as planned: {report}")
        fleet.schedule.run_until(fleet.ground.now_s + _FLOWN_S)
    return said[-listener:]


class _Said(NamedTuple):
    """A robot's message, and how it was encoded."""

    beacon: Beacon
    message: AggregatedMessage
    payload_type: PayloadType


class _Others:
    """A process that speaks for so many robots while the context lasts; `sent` are messages."""

    def __init__(self, group: Group, count: int, said: Sequence[_Said]) -> None:
        spawn = get_context("spawn")
        self._stop = spawn.Event()
        self._sent = spawn.Value("q", 0)
        self._process = spawn.Process(
            target=_speak, args=(group, count, said, self._stop, self._sent)
        )

    def __enter__(self) -> Self:
        self._process.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._process.join()

    @property
    def sent(self) -> int:
        """So far."""
        sent: int = self._sent.value
        return sent


def _speak(
    group: Group, count: int, said: Sequence[_Said], stop: Event, sent: "Synchronized[int]"
) -> None:
    bundle_id = load_policy(load_bundle(BUNDLE)).bundle_id
    members = SimulatedMembers(_FLEET)
    links = [_robot(group, members, robot_id) for robot_id in range(1, count + 1)]
    period_s = 1.0 / MESSAGE.rate_hz
    epoch = 1 + max(message.boot_epoch for _, message, _ in said)
    # Programs that nobody starts together.
    phases = np.random.default_rng(_SEED).uniform(0.0, period_s, count).tolist()
    turns = sorted(zip(phases, range(count), strict=True))
    began_s = time.monotonic()
    for sequence in itertools.count(1):
        for phase_s, robot in turns:
            due_s = began_s + (sequence - 1) * period_s + phase_s
            if stop.wait(max(0.0, due_s - time.monotonic())):
                return
            beacon, message, payload_type = said[robot % len(said)]
            told = replace(beacon, robot_id=robot + 1, boot_epoch=epoch, sequence=sequence)
            its = replace(message, robot_id=robot + 1, boot_epoch=epoch, sequence=sequence)
            data = encode_beacon(told) + encode(its, bundle_id, payload_type)
            links[robot].publish(MESSAGE, data)
            sent.value += 1
        if not turns and stop.wait():
            return


def _robot(group: Group, members: SimulatedMembers, robot_id: int) -> Link:
    guard = members.guard(Role.ROBOT, f"r{robot_id}", robot_id, _START, time.monotonic)
    return guard.over(_Sending(group, robot_id))


class _Sending:
    """The half of a multicast link that speaks."""

    sends_again = False

    def __init__(self, group: Group, robot_id: int) -> None:
        self._place = group.address, group.port
        self._robot_id = robot_id
        self._key = GroupKey.of(group.keys[0])
        self._count = itertools.count()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(
            socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(group.interface)
        )

    def publish(self, topic: Topic, data: bytes) -> None:
        """To the group."""
        number = number_in(data) or MessageNumber(_START, next(self._count))
        for datagram in datagrams(
            data, topic=topic, sender=self._robot_id, number=number, key=self._key
        ):
            self._socket.sendto(datagram, self._place)

    def is_claimed(self, _: int) -> bool:
        """Nobody is heard here."""
        return False

    def peers(self) -> int:
        """As many."""
        return 0

    def refused(self) -> int:
        """As many."""
        return 0
