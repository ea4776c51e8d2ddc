"""Only members of the fleet are heard, each only as itself."""

from collections.abc import Mapping
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.identity.card import Card, CardError, Revocations, Role, signed
from edge.identity.envelope import OVERHEAD_BYTES
from edge.identity.guard import CardProblem, Membership, SignedGuard, Speaker, Unguarded
from edge.identity.news import MessageNumber
from edge.identity.signature import Signer
from edge.messages.topics import (
    CARD,
    GROUND_CARD,
    HOLD,
    MESSAGE,
    ORDER,
    REVOKED,
    STATE,
    STATUS,
    ReceiveCallback,
    Topic,
)

AUTHORITY = Signer(b"a" * 32)
OTHER_FLEET = Signer(b"b" * 32)


def membership(
    role: Role,
    name: str,
    robot_id: int | None = None,
    *,
    authority: Signer = AUTHORITY,
    start: int = 1,
    serial: int = 1,
    key: str = "",
) -> Membership:
    signer = Signer((key or f"{role} {name}").encode().ljust(32, b"."))
    card = Card("demo", role, name, signer.public_key, serial, 2e9, robot_id)
    return Membership(authority.public_key, signer, signed(card, authority), start)


class Member:
    """A guard, what it hears, and what it sends: by topic, as it goes over the air."""

    def __init__(
        self, member: Membership, revocations: bytes = b"", *, sends_again: bool = True
    ) -> None:
        self.now_s = 0.0
        self.sends_again = sends_again
        self.guard = SignedGuard(member, lambda: self.now_s, revocations)
        self.heard: list[tuple[str, bytes, Speaker]] = []
        topics: Mapping[Topic, ReceiveCallback] = self.guard.subscriptions(
            dict.fromkeys(
                (MESSAGE, STATUS, STATE, HOLD, ORDER), lambda *said: self.heard.append(said)
            )
        )
        self._topics = topics
        self.sent: list[tuple[Topic, bytes]] = []
        self._link = self.guard.over(self)

    def publish(self, topic: Topic, data: bytes) -> None:
        self.sent.append((topic, data))

    def is_claimed(self, robot_id: int) -> bool:
        return robot_id == 7

    def peers(self) -> int:
        return 3

    def refused(self) -> int:
        return 11

    def say(self, topic: Topic, data: bytes) -> list[tuple[Topic, bytes]]:
        """What goes out for it."""
        self.sent = []
        self._link.publish(topic, data)
        return self.sent

    def key(self, topic: Topic) -> str:
        card = self.guard.card
        sender = "ground" if card.robot_id is None else f"robot/{card.robot_id}"
        return f"{sender}/{topic.name}"

    def hear(self, other: "Member", sent: list[tuple[Topic, bytes]], key: str = "") -> None:
        for topic, data in sent:
            self._topics[topic](key or other.key(topic), data)

    def takes(self, topic: Topic, key: str, data: bytes) -> bool:
        before = len(self.heard)
        self._topics[topic](key, data)
        return len(self.heard) > before


def robot(robot_id: int, **changes: object) -> Member:
    return Member(membership(Role.ROBOT, f"r{robot_id}", robot_id, **changes))  # type: ignore[arg-type]


@pytest.fixture
def one() -> Member:
    return robot(1)


@pytest.fixture
def two(one: Member) -> Member:
    """Known to `one`, which heard its card."""
    member = robot(2)
    one.hear(member, member.say(MESSAGE, b"first"))
    return member


def test_a_program_that_began_again_is_shown_the_cards_soon(one: Member, two: Member) -> None:
    one.say(MESSAGE, b"")
    one.now_s = 1.0
    one.hear(two, two.say(MESSAGE, b"still the same"))
    assert [t for t, _ in one.say(MESSAGE, b"")] == [MESSAGE]
    again = robot(2, start=2)
    one.hear(again, again.say(MESSAGE, b"begun again")[1:])
    assert [t for t, _ in one.say(MESSAGE, b"")] == [CARD, MESSAGE]


def test_a_member_shows_its_card_and_is_heard_as_itself(one: Member) -> None:
    two = robot(2)
    (topic, card), (_, message) = sent = two.say(MESSAGE, b"hello")
    assert topic is CARD and len(message) == len(b"hello") + OVERHEAD_BYTES
    # Unknown as long as its card was not heard; then at once.
    assert not one.takes(MESSAGE, "robot/2/message", message)
    one.hear(two, sent)
    assert one.heard == [
        ("robot/2/message", b"hello", Speaker(Role.ROBOT, "r2", MessageNumber(1, 1)))
    ]
    assert one.guard.refused() == {"unknown_key": 1}
    # Who hears somebody new shows its own card soon.
    assert [t for t, _ in one.say(MESSAGE, b"")] == [CARD, MESSAGE]
    one.now_s = 0.1
    assert [t for t, _ in one.say(MESSAGE, b"")] == [MESSAGE]
    one.now_s = 2.1
    assert [t for t, _ in one.say(MESSAGE, b"")] == [CARD, MESSAGE]
    # The same card again is no news.
    assert not one.takes(CARD, "robot/2/card", card)


def test_cards_are_rare_once_all_know_all(one: Member, two: Member) -> None:
    def shown_at_s(until_s: int) -> list[int]:
        shown = []
        for now_s in range(int(one.now_s), until_s):
            one.now_s = float(now_s)
            if CARD in [topic for topic, _ in one.say(MESSAGE, b"")]:
                shown.append(now_s)
        return shown

    # `two` was new, and may have missed some.
    assert shown_at_s(60) == [*range(0, 20, 2), *range(28, 60, 10)]
    again = robot(2, start=2)
    one.hear(again, again.say(MESSAGE, b"begun again"))
    assert shown_at_s(100) == [*range(59, 79, 2), *range(87, 100, 10)]


def test_where_cards_get_lost_whoever_is_new_is_shown_them_again_at_once() -> None:
    one, two = Member(membership(Role.ROBOT, "r1", 1), sends_again=False), robot(2)
    one.say(MESSAGE, b"")
    one.now_s = 60.0
    one.hear(two, two.say(MESSAGE, b"begun"))
    shown_s = []
    for tenths in range(600, 720):
        one.now_s = tenths / 10.0
        if CARD in [topic for topic, _ in one.say(MESSAGE, b"")]:
            shown_s.append(round(one.now_s - 60.0, 1))
    assert shown_s == [0.0, 0.5, 1.0, 3.0, 5.0, 7.0, 9.0, 11.0]


@pytest.mark.parametrize("start", [4, 5])
def test_its_own_words_are_no_news_whoever_says_them_again(start: int) -> None:
    """Also those from before its program began again, for as long as somebody goes on."""
    one, former = robot(1, start=5), robot(1, start=start)
    for second in range(20):
        one.now_s = float(second)
        ((_, said),) = former.say(MESSAGE, b"")[-1:]
        assert not one.takes(MESSAGE, "robot/1/message", said)
    assert not one.heard and not one.guard.robots_said_twice()
    # Another program with its key that began later is heard.
    ((_, said),) = robot(1, start=6).say(MESSAGE, b"another")[-1:]
    assert one.takes(MESSAGE, "robot/1/message", said)


@given(at=st.integers(0, 10_000), bit=st.integers(0, 7), payload=st.binary(max_size=300))
def test_no_changed_message_is_heard(at: int, bit: int, payload: bytes) -> None:
    one, two = robot(1), robot(2)
    one.hear(two, two.say(MESSAGE, b"first"))
    ((_, data),) = two.say(MESSAGE, payload)
    changed = bytearray(data)
    changed[at % len(data)] ^= 1 << bit
    assert not one.takes(MESSAGE, "robot/2/message", bytes(changed))
    assert one.takes(MESSAGE, "robot/2/message", data)


@given(st.binary(max_size=200))
def test_no_bytes_are_a_message_or_a_card(data: bytes) -> None:
    one = robot(1)
    for topic, key in ((MESSAGE, "robot/2/message"), (CARD, "robot/2/card")):
        assert not one.takes(topic, key, data)
    one._topics[REVOKED]("ground/revoked", data)
    assert one.guard.revocations == b""


def test_a_message_counts_once_and_for_its_own_place_only(one: Member, two: Member) -> None:
    ((_, data),) = two.say(MESSAGE, b"second")
    assert not one.takes(MESSAGE, "robot/3/message", data)
    assert not one.takes(STATUS, "robot/2/status", data)
    assert not one.takes(STATE, "ground/state", data)
    assert one.takes(MESSAGE, "robot/2/message", data)
    assert not one.takes(MESSAGE, "robot/2/message", data)
    ((_, third),) = two.say(MESSAGE, b"third")
    ((_, fourth),) = two.say(MESSAGE, b"fourth")
    assert one.takes(MESSAGE, "robot/2/message", fourth)
    assert not one.takes(MESSAGE, "robot/2/message", third)
    # Its program starts again; what the former one said is over, whatever its sequence.
    again = robot(2, start=2)
    assert one.takes(MESSAGE, "robot/2/message", again.say(MESSAGE, b"anew")[-1][1])
    ((_, former),) = two.say(MESSAGE, b"fifth")
    assert not one.takes(MESSAGE, "robot/2/message", former)
    assert one.guard.refused()["replayed"] == 3


def test_two_programs_with_one_key_are_told_from_a_new_start(one: Member, two: Member) -> None:
    again = robot(2, start=2)

    def both_speak(until_s: float) -> None:
        while one.now_s < until_s:
            one.now_s += 0.5
            one.hear(again, again.say(MESSAGE, b"new")[-1:])
            one.hear(two, two.say(MESSAGE, b"old")[-1:])

    # What was on its way when the program started again, and then a second program.
    both_speak(4.0)
    assert one.guard.robots_said_twice() == Unguarded(1).robots_said_twice() == set()
    both_speak(8.0)
    assert one.guard.robots_said_twice() == {2}
    one.now_s += 6.0
    assert one.guard.robots_said_twice() == set()
    # One and the same message over and over is no program.
    ((_, data),) = two.say(MESSAGE, b"once")[-1:]
    for _ in range(20):
        one.now_s += 0.5
        assert not one.takes(MESSAGE, "robot/2/message", data)
    assert one.guard.robots_said_twice() == set()


def test_a_robots_key_is_no_operators_and_no_other_robots(one: Member, two: Member) -> None:
    data = two.guard.seal(STATE, b"land")
    for topic, key in (
        (STATE, "ground/state"),
        (ORDER, "ground/order"),
        (STATUS, "robot/1/status"),
    ):
        assert not one.takes(topic, key, data)
    # A card for one is none for another.
    one.hear(two, robot(3).say(STATUS, b"")[:1])
    assert one.guard.refused()["not_allowed"] == 4


def test_a_card_counts_in_its_owners_envelope_only(one: Member) -> None:
    two, three = robot(2), membership(Role.ROBOT, "r3", 3)
    one._topics[CARD]("robot/3/card", three.card_data)
    one._topics[CARD]("robot/3/card", two.guard.seal(CARD, three.card_data))
    assert one.guard.refused() == {"no_envelope": 1, "forged": 1}
    ((_, status),) = Member(three).say(STATUS, b"here")[-1:]
    assert not one.takes(STATUS, "robot/3/status", status)


def test_a_ground_that_began_again_and_says_nothing_is_shown_the_cards_soon(one: Member) -> None:
    """One that does not command shows its card alone."""

    def ground(start: int) -> Member:
        return Member(membership(Role.OPERATOR, "ann", start=start))

    def introduced(member: Member) -> list[tuple[Topic, bytes]]:
        member.sent = []
        member.guard.introduce()
        return member.sent

    former, again = ground(1), ground(2)
    one.hear(former, introduced(former))
    one.say(MESSAGE, b"")
    one.now_s = former.now_s = 60.0
    one.say(MESSAGE, b"")
    one.now_s = former.now_s = 61.0
    one.hear(former, introduced(former))
    assert [t for t, _ in one.say(MESSAGE, b"")] == [MESSAGE]
    shown = introduced(again)
    one.hear(again, shown)
    assert [t for t, _ in one.say(MESSAGE, b"")] == [CARD, MESSAGE]
    # Said again by somebody else, it is no news.
    one.now_s = 61.5
    one.hear(again, shown)
    assert [t for t, _ in one.say(MESSAGE, b"")] == [MESSAGE]


def test_an_observer_says_a_hold_and_nothing_else(one: Member) -> None:
    observer = Member(membership(Role.OBSERVER, "guest"))
    operator = Member(membership(Role.OPERATOR, "ann"))
    for member, heard in ((observer, [True, False, False]), (operator, [True, True, True])):
        sent = member.say(HOLD, b"hold")
        assert [topic for topic, _ in sent] == [GROUND_CARD, HOLD]
        one.hear(member, sent[:1])
        said = [sent[1], *(member.say(topic, b"other")[-1] for topic in (ORDER, STATE))]
        assert [one.takes(t, member.key(t), data) for t, data in said] == heard
    assert [(speaker.role, speaker.name) for *_, speaker in one.heard] == [
        (Role.OBSERVER, "guest"),
        *[(Role.OPERATOR, "ann")] * 3,
    ]


def test_another_fleet_is_not_heard_even_of_the_same_name_and_key(one: Member) -> None:
    stranger = robot(2, authority=OTHER_FLEET)
    one.hear(stranger, stranger.say(MESSAGE, b"hello"))
    assert not one.heard and one.guard.refused() == {"forged": 1, "unknown_key": 1}
    # A key that both fleets have signs for one of them.
    ours = robot(2)
    one.hear(ours, ours.say(MESSAGE, b"")[:1])
    assert not one.takes(MESSAGE, "robot/2/message", stranger.guard.seal(MESSAGE, b"hello"))


def test_who_was_replaced_is_not_heard_any_more(one: Member, two: Member) -> None:
    swapped = robot(2, serial=2, key="another computer")
    one.hear(swapped, swapped.say(MESSAGE, b"I am two"))
    assert one.heard[-1][1] == b"I am two"
    assert not one.takes(MESSAGE, "robot/2/message", two.guard.seal(MESSAGE, b"so am I"))
    # The former card does not come back, and its holder knows why nobody listens.
    two.now_s = 9.0
    one.hear(two, two.say(MESSAGE, b"hello?"))
    assert one.heard[-1][1] == b"I am two"
    assert two.guard.card_problem(1.9e9) is None
    assert two.guard.card_problem(2.1e9) is CardProblem.EXPIRED
    swapped.now_s = 9.0
    two.hear(swapped, swapped.say(MESSAGE, b"")[:1])
    assert two.guard.card_problem(1.9e9) is CardProblem.REPLACED


def test_a_revoked_key_is_not_heard_and_a_list_only_grows(one: Member, two: Member) -> None:
    lists = [
        signed(Revocations(count, tuple(fingerprints)), AUTHORITY)
        for count, fingerprints in ((1, []), (2, [two.guard.card.fingerprint.hex()]), (3, []))
    ]
    forged = signed(Revocations(9, ()), OTHER_FLEET)
    assert one.takes(MESSAGE, "robot/2/message", two.guard.seal(MESSAGE, b"1"))
    for data in (lists[0], lists[1], forged, lists[0]):
        one._topics[REVOKED]("ground/revoked", data)
    assert one.guard.revocations == lists[1]
    assert not one.takes(MESSAGE, "robot/2/message", two.guard.seal(MESSAGE, b"2"))
    assert one.guard.revoked_robots() == {2}
    # It is known from the disk, too, and to who was revoked.
    revoked = Member(membership(Role.ROBOT, "r2", 2), lists[1])
    assert revoked.guard.card_problem(1.9e9) is CardProblem.REVOKED
    # An operator carries it on, an observer does not.
    operator = Member(membership(Role.OPERATOR, "ann"), lists[1])
    assert (REVOKED, lists[1]) in operator.say(STATE, b"")
    observer = Member(membership(Role.OBSERVER, "guest"), lists[1])
    assert REVOKED not in dict(observer.say(STATE, b""))
    one._topics[REVOKED]("ground/revoked", lists[2])
    assert one.takes(MESSAGE, "robot/2/message", two.guard.seal(MESSAGE, b"3"))
    assert one.guard.revoked_robots() == Unguarded(1).revoked_robots() == set()


def test_a_card_must_be_the_keys_beside_it() -> None:
    member = membership(Role.ROBOT, "r1", 1)
    with pytest.raises(CardError, match="for another key"):
        SignedGuard(replace(member, signer=Signer(b"x" * 32)), lambda: 0.0)
    with pytest.raises(CardError, match="has not signed it"):
        SignedGuard(replace(member, authority=OTHER_FLEET.public_key), lambda: 0.0)
    with pytest.raises(ValueError, match="a robot has one, and nobody else"):
        Card("demo", Role.ROBOT, "r1", b"k" * 32, 1, 2e9)


def test_without_a_guard_a_message_is_its_keys() -> None:
    heard: list[tuple[str, bytes, Speaker]] = []
    guard = Unguarded(5)
    topics = guard.subscriptions(dict.fromkeys((MESSAGE, STATE), lambda *said: heard.append(said)))
    assert topics[MESSAGE]("robot/3/message", guard.seal(MESSAGE, b"m"))
    assert topics[STATE]("ground/state", guard.seal(STATE, b"s"))
    assert heard == [
        ("robot/3/message", b"m", Speaker(Role.ROBOT, "", MessageNumber(5, 1))),
        ("ground/state", b"s", Speaker(Role.OPERATOR, "", MessageNumber(5, 1))),
    ]
    # What is not in an envelope, or in a member's.
    for data in (b"m", robot(3).guard.seal(MESSAGE, b"m")):
        assert not topics[MESSAGE]("robot/3/message", data)
    assert len(heard) == 2 and guard.refused() == {"no_envelope": 2}


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
    for topic in (MESSAGE, STATUS, CARD):
        member.guard._sequences[member.key(topic)] = sequence - 1
    return member


def speak(
    hearer: Member, member: Member, until_s: float, topic: Topic = MESSAGE
) -> list[tuple[str, bytes, Speaker]]:
    """Return what is heard of a member that speaks at 4 Hz and shows its card."""
    before = len(hearer.heard)
    while hearer.now_s < until_s:
        hearer.now_s += 0.25
        member.now_s = hearer.now_s
        hearer.hear(member, member.say(topic, b"word"))
    return hearer.heard[before:]


def packet(member: Member, topic: Topic = MESSAGE) -> list[tuple[Topic, bytes]]:
    """One message alone, without its card."""
    return [(topic, member.guard.seal(topic, b"stolen"))]


@pytest.mark.parametrize("topic", [MESSAGE, STATUS])
def test_no_start_beyond_a_day_mutes_a_robot(one: Member, topic: Topic) -> None:
    one.guard.hear_time(NOW_S)
    two, enemy = begun(2, -60.0), thief(2, 2**48 if topic is MESSAGE else 1.1 * DAY_MS)
    assert speak(one, two, 5.0, topic)
    one.hear(enemy, packet(enemy, topic))
    assert one.guard.refused()["start_ahead"] == 1
    assert len(speak(one, two, 6.0, topic)) == 4
    # And the operator is told: while the real one is heard, its key is somebody else's too.
    assert one.guard.robots_said_twice() == one.guard.robots_ahead() == {2}
    speak(one, two, 20.0, topic)
    assert one.guard.robots_said_twice() == one.guard.robots_ahead() == set()


@pytest.mark.parametrize("ahead_ms", [-60e3, 0.9 * DAY_MS], ids=["its own start", "a later one"])
def test_whom_a_thief_silenced_is_heard_again_once_it_starts_again(
    one: Member, ahead_ms: float
) -> None:
    one.guard.hear_time(NOW_S)
    two, enemy = begun(2, -60.0), thief(2, ahead_ms)
    assert speak(one, two, 5.0)
    one.hear(enemy, stolen := packet(enemy))
    speak(one, two, 12.0)
    assert one.guard.robots_said_twice() == {2}, "and others say so"
    again = begun(2, 13.0)
    assert len(speak(one, again, 20.0)) == 32
    # What the thief said is over, and so is what the robot said before.
    one.hear(enemy, stolen)
    one.hear(two, packet(two))
    assert one.heard[-1][1] == b"word" and len(speak(one, again, 21.0)) == 4


def test_a_start_that_was_heard_before_the_time_was_known_mutes_nobody_for_good(
    one: Member,
) -> None:
    """A robot that lost its clock knows the time once it hears its ground."""
    two, enemy = begun(2, -60.0), thief(2, 2**48)
    assert speak(one, two, 1.0)
    one.hear(enemy, packet(enemy))
    assert not speak(one, two, 3.0)
    one.guard.hear_time(NOW_S + 3.0)
    assert speak(one, begun(2, 4.0), 5.0)


def test_a_clock_that_is_set_back_makes_nobody_deaf_in_flight(one: Member) -> None:
    one.guard.hear_time(NOW_S)
    two = begun(2, -60.0)
    assert speak(one, two, 1.0)
    one.guard.hear_time(NOW_S - 30 * 86_400.0)
    assert len(speak(one, two, 2.0)) == 4 and not one.guard.robots_ahead()


def test_a_card_of_an_earlier_start_is_not_taken_for_the_robots(one: Member) -> None:
    """The link would take an earlier start for the one that lives."""
    shown = one.guard.subscriptions({})[CARD]

    def card(member: Member) -> bytes:
        return member.guard.seal(CARD, member.guard._membership.card_data)

    former = card(robot(2, start=1))
    assert shown("robot/2/card", former) is True
    assert shown("robot/2/card", card(robot(2, start=2))) is True
    assert shown("robot/2/card", former) is False
    assert one.guard.refused() == {}


def test_a_ground_is_heard_whatever_its_clock_was(one: Member) -> None:
    """Robots in flight hear their ground, though its laptop's clock was wrong once."""
    one.guard.hear_time(NOW_S)
    ground = Member(membership(Role.OPERATOR, "ann", start=int(1e3 * NOW_S + 30 * DAY_MS)))
    assert speak(one, ground, 1.0, STATE)
    # Its clock was set right, and it started again.
    again = Member(membership(Role.OPERATOR, "ann", start=int(1e3 * (NOW_S + 2.0))))
    assert speak(one, again, 3.0, STATE)


def test_messages_that_overtake_each_other_are_no_second_program(one: Member, two: Member) -> None:
    late: list[tuple[Topic, bytes]] = []
    for quarter in range(80):
        one.now_s = 0.25 * quarter
        said = packet(two)
        one.hear(two, [*packet(two), *late, *late])
        late = said
    assert one.guard.refused()["replayed"] > 100
    assert one.guard.robots_said_twice() == set()


def test_a_robot_hears_that_another_has_its_key(one: Member) -> None:
    one.hear(robot(2), packet(robot(2)))
    enemy = robot(1, start=2)
    one.hear(enemy, packet(enemy))
    assert one.guard.robots_said_twice() == {1}


PLACE = "192.0.2.1:7447"


def test_a_knock_counts_once_and_of_members_alone(one: Member) -> None:
    """Of one that was never heard, too; a stranger who recorded it gets in nowhere with it."""
    two, ground = robot(2), Member(membership(Role.OPERATOR, "ann"))
    for member in (two, ground):
        knock = member.guard.knock(PLACE)
        assert not one.guard.is_knock(knock, "192.0.2.2:7447")
        assert one.guard.is_knock(knock, PLACE) and not one.guard.is_knock(knock, PLACE)
        assert one.guard.is_knock(member.guard.knock(PLACE), PLACE)
        changed = bytearray(member.guard.knock(PLACE))
        changed[-1] ^= 1
        assert not one.guard.is_knock(bytes(changed), PLACE)
    # Nor with the own one, nor a card that was shown, nor as another.
    assert not one.guard.is_knock(one.guard.knock(PLACE), PLACE)
    assert not one.guard.is_knock(two.guard.seal(CARD, two.guard._membership.card_data), PLACE)
    assert not one.guard.is_knock(robot(2, authority=OTHER_FLEET).guard.knock(PLACE), PLACE)
    thief = robot(3)
    assert not one.guard.is_knock(
        thief.guard._seal(f"robot/2/knock/{PLACE}", membership(Role.ROBOT, "r2", 2).card_data),
        PLACE,
    )
    revoked = signed(Revocations(1, (two.guard.card.fingerprint.hex(),)), AUTHORITY)
    assert one.guard.hear_revocations(revoked) and not one.guard.is_knock(
        two.guard.knock(PLACE), PLACE
    )


@given(st.binary(max_size=300))
def test_no_bytes_are_a_knock(data: bytes) -> None:
    assert not robot(1).guard.is_knock(data, PLACE)
