"""The group of robots: real sockets, members and strangers."""

import itertools
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from threading import Event, Thread
from typing import Self

import numpy as np
import pytest

from edge.drivers import multicast
from edge.drivers.link import zenoh_link
from edge.drivers.multicast import MulticastLink
from edge.drivers.zenoh_link import ZenohLink
from edge.identity.envelope import HEAD_BYTES, Address, enclose, seal
from edge.identity.group import PART_BYTES, GroupKey, datagrams
from edge.identity.guard import Membership, Sender, SignedGuard, Unguarded
from edge.identity.members import Member, Members, Role
from edge.identity.replay_window import MessageNumber
from edge.identity.signature import Signer
from edge.messages.topics import MESSAGE, STATUS, Group, GroupKeys, Link, LinkSetting
from lpac.sim.ports import free_ports
from tests.process.drivers.test_zenoh_link import Inbox, endpoint, eventually, present

KEY, FORMER = b"k" * 32, b"f" * 32
AUTHORITY = Signer(b"a" * 32)


@pytest.fixture
def group() -> Group:
    (port,) = free_ports(1)
    return Group(
        "239.255.76.80", port, "127.0.0.1", lambda: GroupKeys((KEY, FORMER), KEY), is_secret=True
    )


def signer_of(robot_id: int, enrolled: int = 1) -> Signer:
    """A robot's, of the so many-th time that it was enrolled."""
    return Signer(robot_id.to_bytes(16, "little") + enrolled.to_bytes(16, "little"))


def members(enrolled: int = 1) -> Members:
    """The list of the fleet's robots, when r1 was enrolled so many times."""
    keys = {robot_id: signer_of(robot_id) for robot_id in range(1, 6)}
    keys[1] = signer_of(1, enrolled)
    return Members(
        "test",
        enrolled,
        AUTHORITY.public_key,
        tuple(Member(Role.ROBOT, f"r{i}", i, key.public_key) for i, key in keys.items()),
    )


class Robot:
    """A member of the fleet in the group: what it hears of the others' messages, by their ids."""

    def __init__(
        self,
        group: Group,
        robot_id: int,
        at: str | None = None,
        *,
        start: int = 1,
        enrolled: int = 1,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.heard: dict[str, bytes] = {}
        self.all_heard: list[bytes] = []
        self.heard_at_s: list[float] = []
        listed = members(enrolled)
        self.own = next(m for m in listed.members if m.robot_id == robot_id)
        signer = signer_of(robot_id, enrolled if robot_id == 1 else 1)
        self.guard = SignedGuard(Membership(self.own, signer, listed, start), clock_s)
        self.radio = zenoh_link(
            LinkSetting(
                "test", robot_id, (at or endpoint(),), (), False, {},
                self.guard.subscriptions({MESSAGE: self._hear}), None, group,
            )
        )  # fmt: skip
        self.link: Link = self.guard.wrap(self.radio)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.radio.close()

    def _hear(self, key: str, data: bytes, sender: Sender) -> None:
        self.heard[sender.name] = data
        self.all_heard.append(data)
        self.heard_at_s.append(time.monotonic())


def eventually_hear(sender: Robot, data: bytes, *receivers: Robot) -> None:
    name = sender.own.name

    def heard() -> bool:
        sender.link.publish(MESSAGE, data)
        return all(receiver.heard.get(name) == data for receiver in receivers)

    eventually(heard)


def stranger() -> socket.socket:
    """Somebody on the network."""
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
    return sender


@contextmanager
def recording(group: Group) -> Iterator[list[bytes]]:
    """What a stranger hears of the group."""
    recorded: list[bytes] = []
    done = Event()

    def listen(receiver: socket.socket) -> None:
        while not done.is_set():
            with suppress(TimeoutError):
                recorded.append(receiver.recv(2048))

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        receiver.bind((group.address, group.port))
        membership = socket.inet_aton(group.address) + socket.inet_aton(group.interface)
        receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        receiver.settimeout(0.1)
        thread = Thread(target=listen, args=(receiver,))
        thread.start()
        try:
            yield recorded
        finally:
            done.set()
            thread.join()


def test_robots_hear_each_other_without_a_ground(group: Group) -> None:
    with Robot(group, 1) as first, Robot(group, 2) as second, Robot(group, 3) as third:
        for size in (0, 100, PART_BYTES, 3000):
            eventually_hear(first, b"1" * size, second, third)
            eventually_hear(third, b"3" * size, first, second)
        assert "r1" not in first.heard
        assert first.radio.peers() == 0


def test_everything_else_goes_to_the_ground(group: Group) -> None:
    places, said = [endpoint(), endpoint()], Inbox()
    with (
        Robot(group, 1, places[0]) as first,
        Robot(group, 2, places[1]) as second,
        ZenohLink(
            fleet="test", connect=places,
            subscriptions=dict.fromkeys((MESSAGE, STATUS), said),
        ) as ground,
    ):  # fmt: skip

        def both() -> bool:
            first.link.publish(MESSAGE, b"to robots")
            first.link.publish(STATUS, b"to the ground")
            return "robot/1/status" in said.newest and "r1" in second.heard

        eventually(both)
        eventually(lambda: present(ground) == {1, 2} and first.radio.peers() == 1)
        # It would cross the air once more for each robot.
        assert "robot/1/message" not in said.newest


def test_of_two_programs_without_keys_each_hears_that_the_other_has_its_id(group: Group) -> None:
    everyones = group._replace(is_secret=False)

    def program() -> MulticastLink:
        return MulticastLink(
            everyones, robot_id=1, on_message=None,
            zenoh=ZenohLink(fleet="test", robot_id=1, listen=[endpoint()], autoconnect=False),
        )  # fmt: skip

    with program() as first, program() as second, program() as silent:
        guards = Unguarded(1), Unguarded(2)

        def speak(*links: MulticastLink) -> None:
            for guard, link in zip(guards, links, strict=False):
                guard.wrap(link).publish(MESSAGE, b"here")

        def silent_hears() -> bool:
            speak(first)
            return silent.is_claimed(1)

        eventually(silent_hears)
        # What comes back is no other's.
        assert not first.is_claimed(1)

        def both_hear() -> bool:
            speak(first, second)
            return first.is_claimed(1) and second.is_claimed(1)

        eventually(both_hear)
        assert not first.is_claimed(2)


def test_strangers_are_not_heard_whatever_they_say(group: Group) -> None:
    place = group.address, group.port
    with (
        Robot(group, 1) as first,
        Robot(group, 2) as second,
        stranger() as someone,
        recording(group) as recorded,
    ):
        eventually_hear(first, b"before", second)
        eventually(lambda: recorded)
        forged = datagrams(
            enclose(b"I am r1", MessageNumber(9, 9)), sender=1,
            key=GroupKey.of(b"x" * 32),
        )  # fmt: skip
        heard = dict(second.heard)
        refused = second.radio.refused()
        before = list(recorded)
        for data in (b"", b"LG", b"LG" * 700, *forged):
            someone.sendto(data, place)
        # More often than a robot may speak: and then it speaks.
        for _ in range(300):
            for data in before:
                someone.sendto(data, place)
        eventually(lambda: second.radio.refused() >= refused + 3)
        assert second.heard == heard
        eventually_hear(first, b"after", second)
        assert b"after" not in b"".join(recorded)


def test_no_robot_hears_its_own_words_when_a_stranger_says_them_again(group: Group) -> None:
    """It would take itself for another one with its id, and not take off."""
    with recording(group) as recorded:
        with Robot(group, 1) as former, Robot(group, 2) as second:
            for number in range(20):
                eventually_hear(former, b"before %d" % number, second)
        with Robot(group, 1, start=2) as first, Robot(group, 2) as second, stranger() as someone:
            for number in range(40):
                eventually_hear(first, b"now %d" % number, second)
            for data in list(recorded):
                someone.sendto(data, (group.address, group.port))
            eventually_hear(second, b"after all that", first)
            assert "r1" not in first.heard and not first.guard.duplicate_robots()


def test_a_member_cannot_speak_for_another_nor_make_it_old(group: Group) -> None:
    place = group.address, group.port
    with (
        Robot(group, 1) as first,
        Robot(group, 2) as second,
        Robot(group, 3, start=2) as third,
        stranger() as stolen,
    ):
        eventually_hear(first, b"before", second)
        eventually_hear(third, b"a member", second)
        # What r3 says as r1, and what r1 said under a number that nothing of r1's reaches.
        mine = third.guard.seal(MESSAGE, b"I am r1")
        genuine = first.guard.seal(MESSAGE, b"genuine")
        start, sequence = (2**48 - 1).to_bytes(6, "little"), (2**32 - 1).to_bytes(4, "little")
        at = HEAD_BYTES - len(start + sequence)
        for message in (
            enclose(b"I am r1", GREATEST),
            mine,
            genuine[:at] + start + sequence + genuine[HEAD_BYTES:],
        ):
            (datagram,) = datagrams(message, sender=1, key=GroupKey.of(KEY))
            stolen.sendto(datagram, place)
        eventually(lambda: {"not_allowed", "forged"} <= second.guard.refused().keys())
        eventually_hear(first, b"after", second)
        assert b"genuine" not in second.all_heard


def test_one_packet_with_a_stolen_key_mutes_no_robot_for_good(group: Group) -> None:
    now_ms = int(1e3 * time.time())
    with Robot(group, 2) as second, stranger() as thief:
        second.guard.receive_time(time.time())

        def stolen(start: int) -> bytes:
            said = seal(
                b"stolen",
                signer=signer_of(1),
                address=Address(AUTHORITY.public_key, "robot/1/message"),
                number=MessageNumber(start, 2**32 - 1),
            )
            (datagram,) = datagrams(said, sender=1, key=GroupKey.of(KEY))
            return datagram

        place = group.address, group.port
        with Robot(group, 1, start=now_ms) as first:
            eventually_hear(first, b"before", second)
            thief.sendto(stolen(2**48 - 1), place)
            eventually(lambda: "start_ahead" in second.guard.refused())
            eventually_hear(first, b"still there", second)
            thief.sendto(stolen(now_ms + 20 * 3600 * 1000), place)
            eventually(lambda: second.heard["r1"] == b"stolen")
        with Robot(group, 1, start=int(1e3 * time.time()) + 1) as again:
            eventually_hear(again, b"after its restart", second)
            thief.sendto(stolen(now_ms + 20 * 3600 * 1000), place)
            eventually_hear(again, b"and on", second)


GREATEST = MessageNumber(2**48 - 1, 2**32 - 1)


def said_by_thief(signer: Signer, claimed: Signer, key: bytes) -> bytes:
    """A message as r1's, under the greatest number, with `claimed` as its sender's key."""
    address = Address(AUTHORITY.public_key, "robot/1/message")
    message = seal(b"no word of r1", signer=signer, address=address, number=GREATEST)
    message = message.replace(signer.fingerprint, claimed.fingerprint, 1)
    (datagram,) = datagrams(message, sender=1, key=GroupKey.of(key))
    return datagram


@pytest.mark.parametrize("key", [KEY, FORMER], ids=["the present key", "the former key"])
def test_no_forged_message_keeps_a_robots_own_from_being_heard(group: Group, key: bytes) -> None:
    """Its number is the greatest; the robot has not been heard yet."""
    with Robot(group, 2) as second, stranger() as thief:
        datagram = said_by_thief(Signer(b"t" * 32), signer_of(1), key)

        def refused() -> bool:
            thief.sendto(datagram, (group.address, group.port))
            return "forged" in second.guard.refused()

        eventually(refused)
        with Robot(group, 1) as first:
            eventually_hear(first, b"here", second)


def test_a_stolen_robots_key_does_not_keep_the_new_one_from_being_heard(group: Group) -> None:
    """The robot was enrolled anew; the thief has its former key, and the group's."""
    with Robot(group, 2) as second, stranger() as thief:
        second.guard.update_members(members(enrolled=2))
        datagram = said_by_thief(signer_of(1), signer_of(1), FORMER)

        def refused() -> bool:
            thief.sendto(datagram, (group.address, group.port))
            return "unknown_key" in second.guard.refused()

        eventually(refused)
        with Robot(group, 1, enrolled=2) as first:
            eventually_hear(first, b"here", second)


@contextmanager
def flooding(group: Group, said: list[bytes], rate_hz: float) -> Iterator[None]:
    """Somebody who says that over and over."""
    done = Event()

    def flood(sender: socket.socket) -> None:
        began_s = time.monotonic()
        for count, datagram in enumerate(itertools.cycle(said), 1):
            sender.sendto(datagram, (group.address, group.port))
            if done.wait(max(0.0, began_s + count / rate_hz - time.monotonic())):
                return

    with stranger() as sender:
        thread = Thread(target=flood, args=(sender,))
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()


@pytest.mark.parametrize("names", [[1], range(1000, 3000)], ids=["its name", "many names"])
def test_whoever_has_the_former_key_alone_drowns_out_no_robot_that_begins(
    group: Group, names: Sequence[int]
) -> None:
    said = [
        datagram
        for number, name in enumerate(itertools.islice(itertools.cycle(names), 2000))
        for datagram in datagrams(
            enclose(b"x" * 100, MessageNumber(2**40, number)), sender=name, key=GroupKey.of(FORMER),
        )
    ]  # fmt: skip
    with Robot(group, 2) as second, flooding(group, said, 800.0):
        eventually(lambda: second.radio.refused() > 500)
        with Robot(group, 1) as first:
            eventually_hear(first, b"here", second)
            for number in range(20):
                eventually_hear(first, b"and here %d" % number, second)


def test_who_has_the_former_key_is_heard_and_hears_nothing_new(group: Group) -> None:
    late = group._replace(keys=lambda: GroupKeys((FORMER,), FORMER))
    with Robot(group, 1) as first, Robot(group, 2) as second, Robot(late, 3) as third:
        eventually_hear(third, b"still here", first, second)
        eventually_hear(first, b"with the new key", second)
        assert not third.heard and third.radio.refused() > 0


def test_a_new_key_is_taken_up_while_the_group_is_spoken_in(group: Group) -> None:
    """Whoever is in the air goes on with the former one, and hears those that have the new one."""
    keys = {1: GroupKeys((FORMER,), FORMER), 2: GroupKeys((FORMER,), FORMER)}
    groups = {robot: group._replace(keys=partial(keys.__getitem__, robot)) for robot in keys}
    with Robot(groups[1], 1) as first, Robot(groups[2], 2) as second:
        eventually_hear(first, b"both with the former", second)
        keys[1] = GroupKeys((KEY, FORMER), FORMER)
        eventually_hear(first, b"in the air", second)
        keys[2] = GroupKeys((KEY, FORMER), KEY)
        eventually_hear(second, b"on the ground", first)
        eventually_hear(first, b"still in the air", second)
        keys[1] = GroupKeys((KEY, FORMER), KEY)
        eventually_hear(first, b"landed", second)
        with stranger() as thief:
            said = said_by_thief(signer_of(1), signer_of(1), FORMER)
            refused = second.guard.refused()
            thief.sendto(said, (group.address, group.port))
        eventually_hear(first, b"and on", second)
        assert second.guard.refused() == refused


def test_what_many_say_is_heard_as_well_when_it_is_taken_together(
    group: Group, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few say it here, and count as many."""
    monkeypatch.setattr(multicast, "_BATCH_HZ", 1.0)
    monkeypatch.setattr(multicast, "_RATE_WINDOW_S", 0.1)
    said = [b"%d" % i for i in range(60)]
    with Robot(group, 1) as first, Robot(group, 2) as second:
        eventually_hear(first, b"here", second)
        for data in said:
            first.link.publish(MESSAGE, data)
            time.sleep(0.01)
        eventually(lambda: second.heard["r1"] == said[-1])
    assert second.all_heard[-len(said) :] == said
    # Most of them came with another one.
    pauses_s = np.diff(second.heard_at_s[-len(said) :])
    assert np.median(pauses_s) < 0.005


def test_without_a_network_it_opens_and_waits_for_one(group: Group) -> None:
    nowhere = group._replace(interface="192.0.2.77")
    with Robot(nowhere, 1) as first:
        first.link.publish(MESSAGE, b"to nobody")
        first.link.publish(MESSAGE, b"x" * 100_000)  # More than a group takes.


def test_a_robot_that_hears_only_itself_joins_again(
    group: Group, monkeypatch: pytest.MonkeyPatch
) -> None:
    join, joined = multicast._receiver, []

    def joining(its: Group) -> socket.socket:
        joined.append(join(its))
        return joined[-1]

    monkeypatch.setattr(multicast, "_REJOIN_AFTER_S", 0.5)
    monkeypatch.setattr(multicast, "_receiver", joining)
    with Robot(group, 1) as first:

        def again() -> bool:
            first.link.publish(MESSAGE, b"does anybody hear this?")
            return len(joined) > 2

        eventually(again)
