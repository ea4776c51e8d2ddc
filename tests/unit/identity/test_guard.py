"""Messages of members alone are accepted, each as its own sender's."""

from collections.abc import Mapping
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.wire import deflate
from edge.identity.envelope import OVERHEAD_BYTES
from edge.identity.guard import Membership, Sender, SignedGuard, Unguarded
from edge.identity.members import Member as Listed
from edge.identity.members import Members, MembersError, Role
from edge.identity.replay_window import MessageNumber
from edge.identity.signature import Signer
from edge.messages.topics import HOLD, MESSAGE, ORDER, STATE, STATUS, ReceiveCallback, Topic

AUTHORITY = Signer(b"a" * 32)
OTHER_FLEET = Signer(b"b" * 32)


def signer(name: str) -> Signer:
    return Signer(name.encode().ljust(32, b"."))


def listed(role: Role, name: str, robot_id: int | None = None, key: str = "") -> Listed:
    return Listed(role, name, robot_id, signer(key or name).public_key)


ALL = (
    *(listed(Role.ROBOT, f"r{robot_id}", robot_id) for robot_id in range(1, 10)),
    listed(Role.OPERATOR, "ann"),
    listed(Role.OBSERVER, "guest"),
)


def members(number: int = 1, *, without: str = "", authority: Signer = AUTHORITY) -> Members:
    known = tuple(member for member in ALL if member.name != without)
    return Members("demo", number, authority.public_key, known)


class Member:
    """A guard, its received messages, and its sent ones as they go over the air."""

    def __init__(self, own: Listed, *, start: int = 1, list_: Members | None = None) -> None:
        self.now_s = 0.0
        self.own = own
        membership = Membership(own, signer(own.name), list_ or members(), start)
        self.guard = SignedGuard(membership, lambda: self.now_s)
        self.received: list[tuple[str, bytes, Sender]] = []
        topics: Mapping[Topic, ReceiveCallback] = self.guard.subscriptions(
            dict.fromkeys(
                (MESSAGE, STATUS, STATE, HOLD, ORDER),
                lambda *m: self.received.append(m),
            )
        )
        self._topics = topics
        self.sent: list[tuple[Topic, bytes]] = []
        self._link = self.guard.wrap(self)

    def publish(self, topic: Topic, data: bytes) -> None:
        self.sent.append((topic, data))

    def is_claimed(self, robot_id: int) -> bool:
        return robot_id == 7

    def peers(self) -> int:
        return 3

    def refused(self) -> int:
        return 11

    def send(self, topic: Topic, data: bytes) -> list[tuple[Topic, bytes]]:
        """The sealed messages."""
        self.sent = []
        self._link.publish(topic, data)
        return self.sent

    def key(self, topic: Topic) -> str:
        sender = "ground" if self.own.robot_id is None else f"robot/{self.own.robot_id}"
        return f"{sender}/{topic.name}"

    def receive(self, other: "Member", sent: list[tuple[Topic, bytes]], key: str = "") -> None:
        for topic, data in sent:
            self._topics[topic](key or other.key(topic), data)

    def accepts(self, topic: Topic, key: str, data: bytes) -> bool:
        before = len(self.received)
        self._topics[topic](key, data)
        return len(self.received) > before


def robot(robot_id: int, start: int = 1, list_: Members | None = None) -> Member:
    return Member(ALL[robot_id - 1], start=start, list_=list_)


def operator(start: int = 1) -> Member:
    return Member(listed(Role.OPERATOR, "ann"), start=start)


@pytest.fixture
def one() -> Member:
    return robot(1)


@pytest.fixture
def two() -> Member:
    return robot(2)


def test_a_programs_first_message_is_accepted(one: Member, two: Member) -> None:
    ((topic, message),) = sent = two.send(MESSAGE, b"hello")
    assert topic is MESSAGE and len(message) == len(b"hello") + OVERHEAD_BYTES
    one.receive(two, sent)
    number, digest = MessageNumber(1, 1), members().digest
    assert one.received == [
        ("robot/2/message", b"hello", Sender(Role.ROBOT, "r2", number, members=digest))
    ]
    # Also those of its next start, and a ground's.
    for again, topic in ((robot(2, start=2), MESSAGE), (operator(), STATE), (operator(2), STATE)):
        one.receive(again, again.send(topic, b"restarted"))
    assert len(one.received) == 4 and one.guard.refused() == {}


@pytest.mark.parametrize("start", [4, 5])
def test_replays_of_its_own_messages_are_refused(start: int) -> None:
    """Also those from before its program began again, for as long as somebody goes on."""
    one, former = robot(1, start=5), robot(1, start=start)
    for second in range(20):
        one.now_s = float(second)
        ((_, sent),) = former.send(MESSAGE, b"")[-1:]
        assert not one.accepts(MESSAGE, "robot/1/message", sent)
    assert not one.received and not one.guard.duplicate_robots()
    # Another program with its key that started later is accepted.
    ((_, sent),) = robot(1, start=6).send(MESSAGE, b"another")[-1:]
    assert one.accepts(MESSAGE, "robot/1/message", sent)


@given(at=st.integers(0, 10_000), bit=st.integers(0, 7), payload=st.binary(max_size=300))
def test_a_changed_message_is_refused(at: int, bit: int, payload: bytes) -> None:
    one, two = robot(1), robot(2)
    ((_, data),) = two.send(MESSAGE, payload)
    changed = bytearray(data)
    changed[at % len(data)] ^= 1 << bit
    assert not one.accepts(MESSAGE, "robot/2/message", bytes(changed))
    assert one.accepts(MESSAGE, "robot/2/message", data)


@given(st.binary(max_size=200))
def test_no_bytes_are_a_message(data: bytes) -> None:
    assert not robot(1).accepts(MESSAGE, "robot/2/message", data)


def test_a_message_counts_once_and_for_its_own_place_only(one: Member, two: Member) -> None:
    ((_, data),) = two.send(MESSAGE, b"second")
    assert not one.accepts(MESSAGE, "robot/3/message", data)
    assert not one.accepts(STATUS, "robot/2/status", data)
    assert not one.accepts(STATE, "ground/state", data)
    assert one.accepts(MESSAGE, "robot/2/message", data)
    assert not one.accepts(MESSAGE, "robot/2/message", data)
    ((_, third),) = two.send(MESSAGE, b"third")
    ((_, fourth),) = two.send(MESSAGE, b"fourth")
    assert one.accepts(MESSAGE, "robot/2/message", fourth)
    assert not one.accepts(MESSAGE, "robot/2/message", third)
    # Its program restarts; messages of the former start are refused, whatever their sequence.
    again = robot(2, start=2)
    assert one.accepts(MESSAGE, "robot/2/message", again.send(MESSAGE, b"anew")[-1][1])
    ((_, former),) = two.send(MESSAGE, b"fifth")
    assert not one.accepts(MESSAGE, "robot/2/message", former)
    assert one.guard.refused()["replayed"] == 3


def test_two_programs_with_one_key_differ_from_a_restart(one: Member, two: Member) -> None:
    again = robot(2, start=2)

    def both_send(until_s: float) -> None:
        while one.now_s < until_s:
            one.now_s += 0.5
            one.receive(again, again.send(MESSAGE, b"new")[-1:])
            one.receive(two, two.send(MESSAGE, b"old")[-1:])

    # What was on its way when the program started again, and then a second program.
    both_send(4.0)
    assert one.guard.duplicate_robots() == Unguarded(1).duplicate_robots() == set()
    both_send(8.0)
    assert one.guard.duplicate_robots() == {2}
    one.now_s += 6.0
    assert one.guard.duplicate_robots() == set()
    # One and the same message over and over is no program.
    ((_, data),) = two.send(MESSAGE, b"once")[-1:]
    for _ in range(20):
        one.now_s += 0.5
        assert not one.accepts(MESSAGE, "robot/2/message", data)
    assert one.guard.duplicate_robots() == set()


def test_a_robots_key_is_no_operators_and_no_other_robots(one: Member, two: Member) -> None:
    data = two.guard.seal(STATE, b"land")
    for topic, key in (
        (STATE, "ground/state"),
        (ORDER, "ground/order"),
        (STATUS, "robot/1/status"),
    ):
        assert not one.accepts(topic, key, data)
    assert one.guard.refused()["not_allowed"] == 3


def test_an_observer_may_send_only_a_hold(one: Member) -> None:
    observer = Member(listed(Role.OBSERVER, "guest"))
    for member, accepted in ((observer, [True, False, False]), (operator(), [True, True, True])):
        sent = [(topic, *member.send(topic, b"other")[0][1:]) for topic in (HOLD, ORDER, STATE)]
        assert [one.accepts(t, member.key(t), data) for t, data in sent] == accepted
    assert [(sender.role, sender.name) for *_, sender in one.received] == [
        (Role.OBSERVER, "guest"),
        *[(Role.OPERATOR, "ann")] * 3,
    ]


def test_another_fleet_of_the_same_name_and_key_is_refused(one: Member) -> None:
    stranger = robot(2, list_=members(authority=OTHER_FLEET))
    one.receive(stranger, stranger.send(MESSAGE, b"hello"))
    assert not one.received and one.guard.refused() == {"forged": 1}


def test_senders_not_in_the_list_are_refused(one: Member, two: Member) -> None:
    one.receive(two, two.send(MESSAGE, b"1"))
    one.guard.update_members(members(2, without="r2"))
    assert not one.accepts(MESSAGE, "robot/2/message", two.guard.seal(MESSAGE, b"2"))
    assert one.guard.refused() == {"unknown_key": 1}
    # It may still be there; and one that has the list knows why nobody listens.
    assert one.guard.revoked_robots() == {2} and one.guard.is_member()
    assert two.guard.is_member() and Unguarded(1).is_member()
    two.guard.update_members(members(2, without="r2"))
    assert not two.guard.is_member() and two.guard.revoked_robots() == {2}
    # A member that returns is accepted; its former messages are not.
    one.guard.update_members(members(3))
    assert one.guard.revoked_robots() == Unguarded(1).revoked_robots() == set()
    assert one.accepts(MESSAGE, "robot/2/message", two.guard.seal(MESSAGE, b"3"))


def test_a_replaced_member_is_refused(one: Member, two: Member) -> None:
    swapped = listed(Role.ROBOT, "spare", 2)
    others = tuple(member for member in ALL if member.robot_id != 2)
    later = replace(members(2), members=(*others, swapped))
    one.guard.update_members(later)
    two.guard.update_members(later)
    new = Member(swapped, list_=later)
    assert one.accepts(MESSAGE, "robot/2/message", new.guard.seal(MESSAGE, b"I am two"))
    assert not one.accepts(MESSAGE, "robot/2/message", two.guard.seal(MESSAGE, b"so am I"))
    assert new.guard.is_member() and not two.guard.is_member()
    assert one.guard.revoked_robots() == set()


@pytest.mark.parametrize(
    ("other", "problem"),
    [
        (members(1), "list 1 is not newer than 2"),
        (members(2, without="r3"), "list 2 is not newer than 2"),
        (members(3, authority=OTHER_FLEET), "is another fleet's"),
        (replace(members(3), fleet="field"), "is another fleet's"),
    ],
)
def test_a_list_that_is_older_or_another_fleets_is_not_taken(
    one: Member, other: Members, problem: str
) -> None:
    one.guard.update_members(members(2))
    one.guard.update_members(members(2))
    with pytest.raises(MembersError, match=problem):
        one.guard.update_members(other)
    assert one.guard.members == members(2)


def test_recent_senders_with_another_list_are_named(one: Member, two: Member) -> None:
    ground = operator()

    def both_send() -> str:
        one.receive(two, two.send(MESSAGE, b""))
        one.receive(ground, ground.send(STATE, b""))
        return one.guard.members_differ()

    assert both_send() == Unguarded(1).members_differ() == ""
    ground.guard.update_members(members(2))
    assert both_send() == (
        "the list of members here is 1, and ann has 2, which is newer: run `lpac fleet up`"
    )
    two.guard.update_members(members(2))
    one.guard.update_members(members(3))
    assert "is 3, and r2 has 2, which is older, ann has 2, which is older:" in both_send()
    two.guard.update_members(members(3, without="r4"))
    ground.guard.update_members(members(3))
    assert "is 3, and r2 has another 3:" in both_send()
    # Its earlier message on another topic does not count, nor does an old one.
    one.receive(two, two.send(STATUS, b""))
    one.now_s = 4.0
    two.guard.update_members(members(4))
    one.guard.update_members(members(4))
    one.receive(two, two.send(MESSAGE, b""))
    assert "ann has 3" in one.guard.members_differ() and "r2" not in one.guard.members_differ()
    one.now_s = 9.5
    assert one.guard.members_differ() == ""


def test_without_a_guard_a_message_is_its_keys() -> None:
    received: list[tuple[str, bytes, Sender]] = []
    guard = Unguarded(5)
    topics = guard.subscriptions(dict.fromkeys((MESSAGE, STATE), lambda *m: received.append(m)))
    assert topics[MESSAGE]("robot/3/message", guard.seal(MESSAGE, b"m"))
    assert topics[STATE]("ground/state", guard.seal(STATE, b"s"))
    assert received == [
        ("robot/3/message", b"m", Sender(Role.ROBOT, "", MessageNumber(5, 1))),
        ("ground/state", b"s", Sender(Role.OPERATOR, "", MessageNumber(5, 1))),
    ]
    # What is not in an envelope, or in a member's.
    for data in (b"m", robot(3).guard.seal(MESSAGE, b"m")):
        assert not topics[MESSAGE]("robot/3/message", data)
    assert len(received) == 2 and guard.refused() == {"no_envelope": 2}


@pytest.mark.parametrize(
    "bad",
    [
        b"land",
        b"",
        deflate(b"land")[:-1],
        deflate(b"land") + b"!",
        deflate(bytes(STATE.limit_bytes + 1)),
        deflate(bytes(10**8)),
    ],
    ids=["plain", "nothing", "cut off", "and more", "a byte too long", "a bomb"],
)
def test_what_does_not_inflate_within_its_limit_is_refused(one: Member, bad: bytes) -> None:
    undeflated = STATE._replace(deflated=False)
    open_fleet = Unguarded(5)
    receive = open_fleet.subscriptions({STATE: lambda *_: pytest.fail("it was received")})[STATE]
    assert not one.accepts(STATE, "ground/state", operator().guard.seal(undeflated, bad))
    assert not receive("ground/state", open_fleet.seal(undeflated, bad))
    assert one.guard.refused() == open_fleet.refused() == {"compression": 1}
    largest = bytes(STATE.limit_bytes)
    assert one.accepts(STATE, "ground/state", operator(2).guard.seal(STATE, largest))


def test_the_link_itself_is_asked_for_the_rest(one: Member) -> None:
    assert one._link.is_claimed(7) and not one._link.is_claimed(1) and one._link.peers() == 3
    assert one._link.refused() == 11


DAY_MS = 24 * 3600 * 1000
NOW_S = 1.8e9


def begun(robot_id: int, at_s: float) -> Member:
    """A robot whose program started `at_s` after `NOW_S`, by a clock that is right."""
    return robot(robot_id, start=int(1e3 * (NOW_S + at_s)))


def thief(robot_id: int, ahead_ms: float, sequence: int = 2**32 - 1) -> Member:
    """Somebody with that robot's key, `ahead_ms` ahead of `NOW_S`, and then of every sequence."""
    member = robot(robot_id, start=min(int(1e3 * NOW_S + ahead_ms), 2**48 - 1))
    for topic in (MESSAGE, STATUS):
        member.guard._sequences[member.key(topic)] = sequence - 1
    return member


def exchange(
    receiver: Member, member: Member, until_s: float, topic: Topic = MESSAGE
) -> list[tuple[str, bytes, Sender]]:
    """Messages accepted from a member that sends at 4 Hz."""
    before = len(receiver.received)
    while receiver.now_s < until_s:
        receiver.now_s += 0.25
        member.now_s = receiver.now_s
        receiver.receive(member, member.send(topic, b"word"))
    return receiver.received[before:]


def packet(member: Member, topic: Topic = MESSAGE) -> list[tuple[Topic, bytes]]:
    return [(topic, member.guard.seal(topic, b"stolen"))]


@pytest.mark.parametrize("topic", [MESSAGE, STATUS])
def test_a_start_beyond_a_day_silences_no_robot(one: Member, topic: Topic) -> None:
    one.guard.receive_time(NOW_S)
    two, enemy = begun(2, -60.0), thief(2, 2**48 if topic is MESSAGE else 1.1 * DAY_MS)
    assert exchange(one, two, 5.0, topic)
    one.receive(enemy, packet(enemy, topic))
    assert one.guard.refused()["start_ahead"] == 1
    assert len(exchange(one, two, 6.0, topic)) == 4
    # While the real one is accepted, an alarm reports that its key has a second user.
    assert one.guard.duplicate_robots() == one.guard.robots_with_future_start() == {2}
    exchange(one, two, 20.0, topic)
    assert one.guard.duplicate_robots() == one.guard.robots_with_future_start() == set()


@pytest.mark.parametrize("ahead_ms", [-60e3, 0.9 * DAY_MS], ids=["its own start", "a later one"])
def test_a_robot_silenced_by_a_thief_is_accepted_after_its_restart(
    one: Member, ahead_ms: float
) -> None:
    one.guard.receive_time(NOW_S)
    two, enemy = begun(2, -60.0), thief(2, ahead_ms)
    assert exchange(one, two, 5.0)
    one.receive(enemy, stolen := packet(enemy))
    exchange(one, two, 12.0)
    assert one.guard.duplicate_robots() == {2}, "and others say so"
    again = begun(2, 13.0)
    assert len(exchange(one, again, 20.0)) == 32
    # The thief's messages are refused, and so are the robot's former ones.
    one.receive(enemy, stolen)
    one.receive(two, packet(two))
    assert one.received[-1][1] == b"word" and len(exchange(one, again, 21.0)) == 4


def test_a_start_received_before_the_time_is_known_silences_nobody_for_good(
    one: Member,
) -> None:
    """A robot that lost its clock gets the time from its ground."""
    two, enemy = begun(2, -60.0), thief(2, 2**48)
    assert exchange(one, two, 1.0)
    one.receive(enemy, packet(enemy))
    assert not exchange(one, two, 3.0)
    one.guard.receive_time(NOW_S + 3.0)
    assert exchange(one, begun(2, 4.0), 5.0)


def test_a_clock_set_back_in_flight_refuses_nobody(one: Member) -> None:
    one.guard.receive_time(NOW_S)
    two = begun(2, -60.0)
    assert exchange(one, two, 1.0)
    one.guard.receive_time(NOW_S - 30 * 86_400.0)
    assert len(exchange(one, two, 2.0)) == 4 and not one.guard.robots_with_future_start()


def test_a_ground_is_accepted_whatever_its_clock_was(one: Member) -> None:
    """Robots in flight accept their ground, though its laptop's clock was wrong once."""
    one.guard.receive_time(NOW_S)
    ground = operator(int(1e3 * NOW_S + 30 * DAY_MS))
    assert exchange(one, ground, 1.0, STATE)
    # Its clock was set right, and it started again.
    again = operator(int(1e3 * (NOW_S + 2.0)))
    assert exchange(one, again, 3.0, STATE)


def test_messages_that_overtake_each_other_are_no_second_program(one: Member, two: Member) -> None:
    late: list[tuple[Topic, bytes]] = []
    for quarter in range(80):
        one.now_s = 0.25 * quarter
        sent = packet(two)
        one.receive(two, [*packet(two), *late, *late])
        late = sent
    assert one.guard.refused()["replayed"] > 100
    assert one.guard.duplicate_robots() == set()


def test_a_robot_detects_a_second_user_of_its_key(one: Member) -> None:
    one.receive(robot(2), packet(robot(2)))
    enemy = robot(1, start=2)
    one.receive(enemy, packet(enemy))
    assert one.guard.duplicate_robots() == {1}


PLACE = "192.0.2.1:7447"


def test_a_knock_counts_once_and_of_members_alone(one: Member) -> None:
    """Also from a new member; a recorded knock opens no port for a stranger."""
    two, ground = robot(2), operator()
    for member in (two, ground):
        knock = member.guard.knock(PLACE)
        assert not one.guard.is_knock(knock, "192.0.2.2:7447")
        assert one.guard.is_knock(knock, PLACE) and not one.guard.is_knock(knock, PLACE)
        assert one.guard.is_knock(member.guard.knock(PLACE), PLACE)
        changed = bytearray(member.guard.knock(PLACE))
        changed[-1] ^= 1
        assert not one.guard.is_knock(bytes(changed), PLACE)
    # Nor is its own knock one, nor a message, nor a knock in another's name.
    assert not one.guard.is_knock(one.guard.knock(PLACE), PLACE)
    assert not one.guard.is_knock(two.guard.seal(MESSAGE, b""), PLACE)
    stranger = robot(2, list_=members(authority=OTHER_FLEET))
    assert not one.guard.is_knock(stranger.guard.knock(PLACE), PLACE)
    assert not one.guard.is_knock(robot(3).guard._seal(f"robot/2/knock/{PLACE}", b""), PLACE)
    one.guard.update_members(members(2, without="r2"))
    assert not one.guard.is_knock(two.guard.knock(PLACE), PLACE)


@given(st.binary(max_size=300))
def test_no_bytes_are_a_knock(data: bytes) -> None:
    assert not robot(1).guard.is_knock(data, PLACE)


@pytest.mark.parametrize("robot", ["x", "-1", "03", "65536", "99999999", ""])
def test_a_key_that_is_no_robots_is_refused(robot: str) -> None:
    received: list[object] = []
    guard = Unguarded(start=1)
    subscriptions = guard.subscriptions({MESSAGE: lambda *m: received.append(m)})
    for data in (guard.seal(MESSAGE, b"hi"), b"LE\xff"):
        assert subscriptions[MESSAGE](f"robot/{robot}/message", data) is False
    assert not received and not guard.pop_unreadable_robots()
    assert subscriptions[MESSAGE]("robot/65535/message", guard.seal(MESSAGE, b"hi"))
    assert subscriptions[MESSAGE]("robot/3/message", b"LE\xff") is False
    assert len(received) == 1 and guard.pop_unreadable_robots() == {3}
