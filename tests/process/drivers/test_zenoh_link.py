"""The radio: real sessions here and in processes of their own."""

import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import permutations
from threading import Event, Thread
from typing import Any, Self

import pytest
import zenoh

from edge.drivers.zenoh_link import LinkError, ZenohLink
from edge.messages.topics import EXPLORED, MESSAGE, ORDER, STATE, STATUS, WORLD, Topic
from lpac.sim.ports import free_ports
from tests.conftest import ROOT
from tests.needs import missing

# Robots as a process. A line on its standard input opens them, each further one is answered with
# what every robot hears and sees, and the end of the input closes them.
ROBOTS = """
import json, select, sys
from contextlib import ExitStack
from edge.drivers.zenoh_link import ZenohLink
from edge.messages.topics import MESSAGE

class Robot:
    def __init__(self, stack, settings):
        self.heard = {}
        self.link = stack.enter_context(
            ZenohLink(fleet="test", subscriptions={MESSAGE: self.receive}, **settings)
        )

    def receive(self, key, data):
        self.heard[key.split("/")[1]] = self.heard.get(key.split("/")[1], 0) + 1

    def seen(self):
        with self.link._lock:
            present = {id_ for id_, _ in self.link._tokens} - {self.link._robot_id}
        return {"heard": dict(self.heard), "present": sorted(present)}

print("started", flush=True)
sys.stdin.readline()
with ExitStack() as stack:
    robots = [Robot(stack, settings) for settings in json.loads(sys.argv[1])]
    print("open", flush=True)
    while True:
        for robot in robots:
            robot.link.publish(MESSAGE, json.dumps(robot.seen()).encode().ljust(6000))
        if select.select([sys.stdin], [], [], 0.05)[0]:
            if not sys.stdin.readline():
                break
            print(json.dumps([robot.seen() for robot in robots]), flush=True)
"""


class Inbox:
    """The newest data by key, and how many came."""

    def __init__(self) -> None:
        self.newest: dict[str, bytes] = {}
        self.all: set[bytes] = set()
        self.count = 0
        # Of what is explored.
        self.largest = 0

    def __call__(self, key: str, data: bytes) -> None:
        self.newest[key] = data
        self.all.add(data)
        self.count += 1
        if key.endswith("explored"):
            self.largest = max(self.largest, len(data))

    def from_robot(self, robot_id: int) -> dict[str, Any]:
        seen: dict[str, Any] = json.loads(self.newest.get(f"robot/{robot_id}/message", b"{}"))
        return seen


def endpoint() -> str:
    (port,) = free_ports(1)
    return f"tcp/127.0.0.1:{port}"


def eventually(
    condition: Callable[[], object],
    timeout_s: float = 60.0,
    *,
    why_not: Callable[[], object] = lambda: None,
) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s, why_not()
        time.sleep(0.01)


def present(link: ZenohLink) -> set[int]:
    """Ids of the other robots whose programs are connected."""
    with link._lock:
        return {robot_id for robot_id, _ in link._tokens} - {link._robot_id}


def is_present(link: ZenohLink, robot_ids: set[int]) -> bool:
    return present(link) == robot_ids


def has_peers(link: ZenohLink, count: int) -> bool:
    return link.peers() == count


def eventually_hears(
    sender: ZenohLink, topic: Topic, data: bytes, key: str, *inboxes: Inbox
) -> None:
    def heard() -> bool:
        sender.publish(topic, data)
        return all(inbox.newest.get(key) == data for inbox in inboxes)

    eventually(heard)


class Robots:
    """Robots in a process of their own, one for each of `settings`; `prefix` goes before it."""

    def __init__(self, *settings: dict[str, object], prefix: Sequence[str] = ()) -> None:
        self.process = subprocess.Popen(
            [*prefix, sys.executable, "-c", ROBOTS, json.dumps(settings)],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._read()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()

    def open(self) -> Self:
        self._ask()
        return self

    def seen(self) -> list[dict[str, Any]]:
        """For each robot: `heard`, how many messages of whom, and `present`."""
        answer: list[dict[str, Any]] = json.loads(self._ask())
        return answer

    def _ask(self) -> str:
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return self._read()

    def _read(self) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, "the process ended"
        return line


@contextmanager
def fleet_of(count: int, **settings: Any) -> Iterator[tuple[list[ZenohLink], list[Inbox]]]:
    """Robots 0 to count - 1, all of which know robot 0's endpoint alone."""
    known = endpoint()
    inboxes = [Inbox() for _ in range(count)]
    with ExitStack() as stack:
        links = [
            stack.enter_context(
                ZenohLink(
                    fleet="test",
                    robot_id=robot_id,
                    listen=[known if robot_id == 0 else endpoint()],
                    connect=[] if robot_id == 0 else [known],
                    subscriptions={MESSAGE: inbox},
                    **settings,
                )
            )
            for robot_id, inbox in enumerate(inboxes)
        ]
        yield links, inboxes


def test_robots_that_know_one_peer_hear_all_others_and_not_themselves() -> None:
    with fleet_of(3) as (links, inboxes):
        for sender, link in enumerate(links):
            others = [inbox for receiver, inbox in enumerate(inboxes) if receiver != sender]
            data = bytes([sender]) * 20_000
            eventually_hears(link, MESSAGE, data, f"robot/{sender}/message", *others)
        for robot_id, (link, inbox) in enumerate(zip(links, inboxes, strict=True)):
            others_ids = {0, 1, 2} - {robot_id}
            assert set(inbox.newest) == {f"robot/{other}/message" for other in others_ids}
            eventually(partial(is_present, link, others_ids))
            eventually(partial(has_peers, link, 2))
            assert not link.is_claimed(robot_id)
            assert link._failures.total() == 0


def test_the_ground_speaks_to_all_robots_and_is_none() -> None:
    known, commands, statuses = endpoint(), Inbox(), Inbox()
    with (
        ZenohLink(
            fleet="test",
            robot_id=7,
            listen=[known],
            subscriptions=dict.fromkeys((STATE, ORDER, WORLD), commands),
        ) as robot,
        ZenohLink(fleet="test", connect=[known], subscriptions={STATUS: statuses}) as ground,
    ):
        for topic in (STATE, ORDER):
            eventually_hears(ground, topic, topic.name.encode(), topic.pattern, commands)
        eventually_hears(robot, STATUS, b"fine", "robot/7/status", statuses)
        eventually(lambda: present(ground) == {7})
        assert present(robot) == frozenset()


def test_without_autoconnect_robots_are_connected_to_grounds_alone() -> None:
    """Gossip, by which grounds find each other, makes no mesh of such robots."""
    places, statuses, states = [endpoint(), endpoint()], [Inbox(), Inbox()], Inbox()

    def robot(robot_id: int) -> ZenohLink:
        return ZenohLink(
            fleet="test", robot_id=robot_id, listen=[places[robot_id]], autoconnect=False,
            subscriptions={STATE: states},
        )  # fmt: skip

    def ground(number: int) -> ZenohLink:
        return ZenohLink(
            fleet="test", connect=places,
            subscriptions=dict.fromkeys((STATUS, STATE), statuses[number]),
        )  # fmt: skip

    with robot(0) as first, robot(1) as second, ground(0) as one:
        for what in (b"before", b"after"):
            # It goes, and comes back.
            with ground(1) as other:
                for inbox in statuses:
                    eventually_hears(first, STATUS, what, "robot/0/status", inbox)
                    eventually_hears(second, STATUS, what, "robot/1/status", inbox)
                eventually_hears(other, STATE, what, "ground/state", states)
                eventually_hears(one, STATE, what * 2, "ground/state", states)
                eventually_hears(one, STATE, what, "ground/state", statuses[1])
                eventually_hears(other, STATE, what, "ground/state", statuses[0])
                eventually(lambda: present(one) == {0, 1} and one.peers() == 3)
                assert first.peers() == second.peers() == 2
                assert present(first) == present(second) == frozenset()
            eventually(lambda: first.peers() == second.peers() == 1)


def test_scouting_finds_the_others() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.sendto(b"", ("224.0.0.225", 7446))
        except OSError:
            pytest.skip("no interface for multicast")
    fleet, heard = f"test-{time.time_ns()}", Inbox()
    with (
        ZenohLink(fleet=fleet, robot_id=1, scouting=True) as first,
        ZenohLink(fleet=fleet, robot_id=2, scouting=True, subscriptions={MESSAGE: heard}) as second,
    ):
        eventually(lambda: present(first) == {2} and present(second) == {1})
        eventually_hears(first, MESSAGE, b"hello", "robot/1/message", heard)


def test_peers_start_in_any_order() -> None:
    late = endpoint()
    with ZenohLink(fleet="test", robot_id=2, connect=[late]) as early:
        assert present(early) == frozenset()
        with ZenohLink(fleet="test", robot_id=1, listen=[late]):
            eventually(lambda: present(early) == {1})


def test_neighbours_join_leave_and_come_back() -> None:
    with fleet_of(2) as (links, inboxes):
        known = endpoint()
        eventually(lambda: present(links[0]) == {1} and present(links[1]) == {0})
        with ZenohLink(fleet="test", robot_id=10, listen=[known]) as first:
            for sequence in (b"first", b"second"):
                with ZenohLink(
                    fleet="test",
                    robot_id=11,
                    connect=[known],
                    subscriptions={MESSAGE: inboxes[0]},
                ):
                    eventually(lambda: present(first) == {11})
                    eventually_hears(first, MESSAGE, sequence, "robot/10/message", inboxes[0])
                eventually(lambda: present(first) == frozenset())


def test_a_killed_neighbour_leaves_and_its_successor_is_heard() -> None:
    with fleet_of(2) as (links, inboxes):
        known = endpoint()
        everybody = Inbox()
        with ZenohLink(
            fleet="test", robot_id=5, listen=[known], subscriptions={MESSAGE: everybody}
        ) as link:
            for _ in range(2):
                with Robots({"robot_id": 6, "connect": [known]}).open() as robots:
                    eventually(lambda: present(link) == {6})
                    everybody.newest.clear()
                    eventually(lambda: everybody.from_robot(6))
                    robots.process.kill()
                    eventually(lambda: present(link) == frozenset())
        eventually_hears(links[0], MESSAGE, b"still here", "robot/0/message", inboxes[1])


def test_messages_flow_again_with_a_process_that_was_stopped() -> None:
    known, inbox = endpoint(), Inbox()
    with (
        ZenohLink(fleet="test", robot_id=1, listen=[known], subscriptions={MESSAGE: inbox}) as link,
        Robots({"robot_id": 2, "connect": [known]}).open() as robots,
    ):

        def heard_back() -> int:
            link.publish(MESSAGE, bytes(20_000))
            count: int = inbox.from_robot(2).get("heard", {}).get("1", 0)
            return count

        eventually(heard_back)
        robots.process.send_signal(signal.SIGSTOP)
        eventually(lambda: present(link) == frozenset())
        for _ in range(100):  # a publisher that is not stopped by what the other does not take
            heard_back()
        heard_before = heard_back()
        robots.process.send_signal(signal.SIGCONT)
        eventually(lambda: present(link) == {2})
        eventually(lambda: heard_back() > heard_before + 10)


def test_two_robots_of_one_id_are_seen_by_both() -> None:
    with fleet_of(2) as (links, _), ExitStack() as stack:
        known = endpoint()
        ground = stack.enter_context(ZenohLink(fleet="test", listen=[known]))
        first, second, other = (
            stack.enter_context(ZenohLink(fleet="test", robot_id=robot_id, connect=[known]))
            for robot_id in (3, 3, 4)
        )
        eventually(lambda: first.is_claimed(3) and second.is_claimed(3))
        eventually(lambda: other.is_claimed(3) and ground.is_claimed(3))
        assert not other.is_claimed(4) and not ground.is_claimed(5)
        eventually(lambda: present(first) == {4})
        second.close()
        eventually(lambda: not first.is_claimed(3))
        assert not links[0].is_claimed(0)


def test_a_callback_that_raises_stops_nothing() -> None:
    known, inbox = endpoint(), Inbox()

    def broken(key: str, data: bytes) -> None:
        inbox(key, data)
        raise RuntimeError("broken")

    with (
        ZenohLink(
            fleet="test", robot_id=1, listen=[known], subscriptions={MESSAGE: broken}
        ) as link,
        ZenohLink(fleet="test", robot_id=2, connect=[known]) as sender,
    ):
        for data in (b"one", b"two"):
            eventually_hears(sender, MESSAGE, data, "robot/2/message", inbox)
        eventually(lambda: link._failures.total() == inbox.count >= 2)


def test_another_fleet_hears_nothing() -> None:
    known, inbox, stranger_inbox = endpoint(), Inbox(), Inbox()
    with (
        ZenohLink(fleet="ours", robot_id=1, listen=[known], subscriptions={MESSAGE: inbox}) as link,
        ZenohLink(fleet="ours", robot_id=2, connect=[known]) as sender,
        ZenohLink(
            fleet="theirs",
            robot_id=3,
            connect=[known],
            subscriptions={MESSAGE: stranger_inbox},
        ) as stranger,
    ):
        eventually(lambda: stranger.peers() == 2)
        eventually_hears(sender, MESSAGE, b"ours", "robot/2/message", inbox)
        eventually(lambda: present(link) == {2})
        assert present(stranger) == frozenset()
        assert stranger_inbox.count == 0


def test_what_cannot_be_opened_is_said_in_one_line() -> None:
    taken = endpoint()

    def error(**settings: Any) -> str:
        arguments: dict[str, Any] = {"fleet": "test", "robot_id": 1} | settings
        with pytest.raises(LinkError) as caught:
            ZenohLink(**arguments)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    assert error(listen=["udp/[::]:1"]) == "listen = 'udp/[::]:1': must be tcp/ADDRESS:PORT"
    assert error(connect=["tcp/10.0.0.1"]) == ("connect = 'tcp/10.0.0.1': must be tcp/ADDRESS:PORT")
    # zenoh would call 127.0.0.9.
    assert error(connect=["tcp/127.0.0.011:1"]).startswith(
        "connect = '127.0.0.011': looks like an address, but is none"
    )
    assert error(fleet="a/*").startswith("fleet = 'a/*': must be")
    assert error(robot_id=-1).startswith("robot_id = -1: must be")
    with ZenohLink(fleet="test", listen=[taken]):
        assert taken in error(listen=[taken])
        assert "another program has this port" in error(listen=[taken])
    assert "no such address" in error(listen=["tcp/192.0.2.77:7447"])


def test_grounds_hear_each_other_and_a_robot_gets_their_world_whole() -> None:
    known, world = endpoint(), b"CircularBND 1.5 2.5 3.5 4.5\n" * 10_000
    of_robot, of_first, of_second = Inbox(), Inbox(), Inbox()
    with (
        ZenohLink(
            fleet="test", robot_id=1, listen=[known],
            subscriptions={WORLD: of_robot, STATE: of_robot},
        ) as robot,
        ZenohLink(fleet="test", connect=[known], subscriptions={
            STATE: of_first, EXPLORED: of_first,
        }) as first,
        ZenohLink(
            fleet="test", connect=[known], subscriptions={STATE: of_second}
        ) as second,
    ):  # fmt: skip
        eventually(lambda: robot.peers() == 2 and present(first) == present(second) == {1})
        eventually_hears(first, STATE, b"first", "ground/state", of_robot, of_second)
        eventually_hears(second, STATE, b"second", "ground/state", of_robot, of_first)
        assert of_second.newest["ground/state"] == b"first"
        eventually_hears(first, WORLD, world, "ground/world", of_robot)
        eventually_hears(robot, EXPLORED, b"cells", "robot/1/explored", of_first)
        with pytest.raises(KeyError):
            robot.publish(WORLD, world)
        # What is larger than its topic allows is not even handed on.
        robot.publish(EXPLORED, bytes(EXPLORED.limit_bytes + 1))
        eventually_hears(robot, EXPLORED, b"more cells", "robot/1/explored", of_first)
        assert of_first.largest <= EXPLORED.limit_bytes


def test_whoever_floods_the_radio_costs_little_and_makes_nobody_deaf() -> None:
    """Anybody who speaks zenoh, without our programs."""
    known, inbox = endpoint(), Inbox()
    with (
        ZenohLink(
            fleet="test", robot_id=0, listen=[known], subscriptions={MESSAGE: inbox, STATE: inbox}
        ) as robot,
        ZenohLink(fleet="test", robot_id=1, listen=[endpoint()], connect=[known]) as neighbour,
        zenoh.open(attacker(known)) as stranger,
    ):
        eventually(partial(has_peers, robot, 2))
        began_s = time.monotonic()
        for sent in range(5000):
            stranger.put("lpac/test/robot/2/message", bytes(64))
            stranger.put(f"lpac/test/robot/{sent + 3}/message", bytes(64))
            stranger.put(f"lpac/test/robot/{'9' * 4300}/message", bytes(64))
        stranger.put("lpac/test/ground/state", bytes(STATE.limit_bytes + 1))
        stranger.put("lpac/test/robot/2/message", bytes(50 * 2**20))
        eventually_hears(neighbour, MESSAGE, b"still there", "robot/1/message", inbox)
        lasted_s = time.monotonic() - began_s
        from_one = MESSAGE.most_hz * (2.0 + lasted_s)
        assert inbox.count <= 1000 + from_one + lasted_s * 100
        assert all(len(data) <= 64 for data in inbox.newest.values())
        assert max(map(len, inbox.newest)) < 40
        assert robot._failures.total() == 0
        # What zenoh itself refuses ends the stranger's connection, and nobody else's.
        eventually(partial(is_present, robot, {1}))


def test_a_ground_that_floods_drowns_no_other() -> None:
    known, inbox, over = endpoint(), Inbox(), Event()
    with (
        ZenohLink(fleet="test", robot_id=0, listen=[known], subscriptions={STATE: inbox}) as robot,
        ZenohLink(fleet="test", connect=[known]) as ground,
        zenoh.open(attacker(known)) as stranger,
    ):
        eventually(partial(has_peers, robot, 2))

        def flood() -> None:
            while not over.is_set():
                stranger.put("lpac/test/ground/state", b"flood")

        flooding = Thread(target=flood)
        flooding.start()
        said: list[bytes] = []

        def say(number: int) -> bool:
            said.append(b"%d" % number)
            ground.publish(STATE, said[-1])
            return said[-1] in inbox.all

        try:
            for number in range(60):
                eventually(partial(say, number))
        finally:
            over.set()
            flooding.join()
        # Of what is said every 10 ms each third is heard.
        assert len(said) < 8 * 60


def attacker(known: str) -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("connect/endpoints", json.dumps([known]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return config


def test_close_twice_then_publish() -> None:
    link = ZenohLink(fleet="test", robot_id=1)
    link.close()
    link.close()
    link.publish(MESSAGE, b"late")
    assert link.peers() == 0
    assert present(link) == frozenset()


def test_the_interpreter_exits_after_an_exception() -> None:
    code = """
from edge.drivers.zenoh_link import ZenohLink
with ZenohLink(fleet="test", robot_id=1, connect=["tcp/127.0.0.1:1"]):
    raise SystemExit(3)
"""
    assert (
        subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False, timeout=120).returncode
        == 3
    )


@pytest.mark.alone
def test_robots_out_of_reach_make_nobody_deaf_and_come_back() -> None:
    """Two robots in one network namespace, seven in another, and a link between them.

    Each process loses 14 connections at once, as many as a robot of a team of 15.
    """
    nearby, far_away = (1, 2), tuple(range(3, 10))
    settings: list[dict[str, object]] = [
        {
            "robot_id": robot_id,
            "listen": [f"tcp/10.0.0.{robot_id}:7447"],
            "connect": [f"tcp/10.0.0.{other}:7447" for other in range(1, robot_id)],
        }
        for robot_id in nearby + far_away
    ]
    if lacks := missing("ip", "unshare"):
        pytest.skip(lacks)
    isolated = ["unshare", "--user", "--map-root-user", "--net"]
    if subprocess.run([*isolated, "true"], check=False).returncode:
        pytest.skip("needs the right to make a network namespace")

    def enter(robots: Robots) -> list[str]:
        user = ["nsenter", "--preserve-credentials", "--user", "--net"]
        return [*user, "--target", str(robots.process.pid)]

    def ip(robots: Robots, command: str) -> None:
        subprocess.run([*enter(robots), "ip", *command.split()], check=True)

    with (
        Robots(*settings[:2], prefix=isolated) as near,
        Robots(*settings[2:], prefix=[*enter(near), "unshare", "--net"]) as far,
    ):
        ip(near, f"link add name radio type veth peer name radio netns {far.process.pid}")
        for robots, addresses in ((near, nearby), (far, far_away)):
            for address in addresses:
                ip(robots, f"addr add 10.0.0.{address}/24 dev radio")
            for device in ("lo", "radio"):
                ip(robots, f"link set {device} up")
        near.open()
        far.open()

        def silence(action: str) -> None:
            """`add` or `del` what swallows the packets from one side to the other."""
            for robots, others in ((near, far_away), (far, nearby)):
                for other in others:
                    ip(robots, f"route {action} blackhole 10.0.0.{other}")

        def heard() -> dict[tuple[int, int], int]:
            return {
                (receiver, int(sender)): count
                for receiver, seen in enumerate(near.seen() + far.seen(), start=1)
                for sender, count in seen["heard"].items()
            }

        def eventually_hear(pairs: list[tuple[int, int]], timeout_s: float = 60.0) -> None:
            before = heard()

            def deaf() -> list[tuple[int, int]]:
                now = heard()
                return [pair for pair in pairs if now.get(pair, 0) <= before.get(pair, 0) + 10]

            eventually(
                lambda: not deaf(),
                timeout_s,
                why_not=lambda: {"deaf": deaf(), "before": before, "present": visible()},
            )

        def visible() -> list[list[int]]:
            return [seen["present"] for seen in near.seen() + far.seen()]

        def others(*teams: tuple[int, ...]) -> list[list[int]]:
            """Robots received by each, if only robots of one team receive each other."""
            return [[other for other in team if other != robot] for team in teams for robot in team]

        all_pairs = list(permutations(nearby + far_away, 2))
        everybody, apart = others(nearby + far_away), others(nearby, far_away)
        pairs_apart = [*permutations(nearby, 2), *permutations(far_away, 2)]
        for _ in range(2):
            eventually_hear(all_pairs)
            eventually(lambda: visible() == everybody)
            silence("add")
            eventually(lambda: visible() == apart)
            # Sooner than the 10 s for which a lost connection may hold a thread.
            eventually_hear(pairs_apart, timeout_s=5.0)
            silence("del")
        eventually_hear(all_pairs)
        silence("add")
        eventually(lambda: visible() == apart)
        for robots in (near, far):
            robots.process.communicate(timeout=8.0)
            assert robots.process.returncode == 0
