"""What came by radio: the newest counts, what is broken is counted, nothing raises."""

import dataclasses
import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from edge.identity.guard import Sender
from edge.identity.members import Role
from edge.messages.codec import encode
from edge.messages.mission import Echo, GroundState, Hold, Order, Origin
from edge.robot.inbox import Inbox
from edge.robot.neighbours import NeighbourTable
from tests.unit.flight.test_preflight import NEIGHBOUR

ANYBODY = Sender(Role.OPERATOR, "")

STATE = GroundState(sequence=5, operator="anna", origin=Origin(40.0, -75.0, 30.0), enabled=True)
ORDER = Order("a", 3, 77, "takeoff", 12.0, "anna")


def make_inbox() -> Inbox:
    return Inbox(robot_id=3, ground_timeout_s=3.0)


def test_without_messages_the_ground_is_infinitely_old() -> None:
    assert make_inbox().ground(10.0) == (None, math.inf)
    assert make_inbox().order(0.0) is None
    assert make_inbox().ground_unix_s(10.0) is None


def test_a_flood_leaves_what_came_last() -> None:
    inbox = make_inbox()
    for number in range(1000):
        inbox.receive_ground(b"", ANYBODY, 0.0)
        inbox.receive_order(encode(dataclasses.replace(ORDER, order_id=str(number))), ANYBODY, 0.0)
    inbox.ground(0.0)
    assert inbox.not_understood_count == 16
    taken = []
    while (order := inbox.order(0.0)) is not None:
        taken.append(order.order_id)
    assert taken == [str(number) for number in range(936, 1000)]


def test_the_ground_state_ages_until_the_next_comes() -> None:
    inbox = make_inbox()
    inbox.receive_ground(encode(STATE), ANYBODY, 1.0)
    assert inbox.ground(1.5) == (STATE, 0.5)
    assert inbox.ground(3.0) == (STATE, 2.0) and inbox.ground_unix_s(3.0) is None
    clocked = dataclasses.replace(STATE, unix_time_s=1e9)
    inbox.receive_ground(encode(clocked), ANYBODY, 3.0)
    assert inbox.ground(3.0) == (clocked, 0.0) and inbox.ground_unix_s(3.5) == 1e9 + 0.5


def test_an_older_state_that_arrives_late_does_not_count() -> None:
    inbox = make_inbox()
    inbox.receive_ground(encode(STATE), ANYBODY, 1.0)
    assert inbox.ground(1.0)[0] == STATE
    older = dataclasses.replace(STATE, sequence=4, safety_action="land")
    inbox.receive_ground(encode(older), ANYBODY, 1.5)
    assert inbox.ground(1.5) == (STATE, 0.5)


def test_a_restarted_ground_counts_once_the_former_is_lost() -> None:
    inbox = make_inbox()
    inbox.receive_ground(encode(STATE), ANYBODY, 1.0)
    inbox.ground(1.0)
    anew = GroundState(sequence=0, operator="ben")
    inbox.receive_ground(encode(anew), ANYBODY, 5.0)
    assert inbox.ground(5.0) == (anew, 0.0)


def test_of_two_grounds_the_greater_sequence_and_then_the_greater_operator_counts() -> None:
    inbox = make_inbox()

    def hear(now_s: float, *states: GroundState) -> tuple[GroundState | None, float]:
        for state in states:
            inbox.receive_ground(encode(state), ANYBODY, now_s)
        return inbox.ground(now_s)

    ben, cleo = (dataclasses.replace(STATE, operator=name) for name in ("ben", "cleo"))
    assert hear(1.0, STATE, ben) == (ben, 0.0)
    # The one that does not count comes last between two ticks of the control loop, for ever.
    for now_s in (1.5, 3.0, 4.5, 6.0, 7.5):
        assert hear(now_s, ben, STATE) == (ben, 0.0)
    assert hear(8.0, STATE) == (ben, 0.5)
    assert hear(8.5, cleo, ben) == (cleo, 0.0)
    took_over = dataclasses.replace(STATE, sequence=6)
    assert hear(9.0, took_over, cleo) == (took_over, 0.0)
    # Once that one is silent, the other counts again.
    state, age_s = hear(11.9, cleo)
    assert state == took_over and age_s == pytest.approx(2.9)
    assert hear(12.1, cleo) == (cleo, 0.0)


def test_orders_for_others_are_passed_over() -> None:
    inbox = make_inbox()
    for robot_id in (1, 3, 2):
        inbox.receive_order(encode(dataclasses.replace(ORDER, robot_id=robot_id)), ANYBODY, 0.0)
    assert inbox.order(0.0) == ORDER
    assert inbox.order(0.0) is None


def test_an_order_that_came_after_the_ticks_time_waits_for_the_next() -> None:
    inbox = make_inbox()
    inbox.receive_order(encode(ORDER), ANYBODY, 5.0)
    assert inbox.order(4.9) is None
    assert inbox.order(5.0) == ORDER


@given(st.binary() | st.text().map(str.encode) | st.just(b"[" * 100_000) | st.just(b"{}"))
def test_what_is_broken_is_counted_and_changes_nothing(data: bytes) -> None:
    inbox = make_inbox()
    inbox.receive_ground(encode(STATE), ANYBODY, 1.0)
    assert inbox.ground(1.0)[0] == STATE
    inbox.receive_ground(data, ANYBODY, 2.0)
    inbox.receive_order(data, ANYBODY, 0.0)
    assert inbox.ground(2.0) == (STATE, 1.0)
    assert inbox.order(0.0) is None
    assert inbox.not_understood_count == 2


def newer(message: GroundState | Order, **changes: object) -> bytes:
    """As another release says it, of which something is out of bounds here."""
    return json.dumps(json.loads(encode(message)) | {"world_id": 7} | changes).encode()


def test_a_state_that_is_not_understood_holds_and_lands_and_ages_the_last_one() -> None:
    inbox = make_inbox()
    inbox.receive_ground(encode(STATE), ANYBODY, 1.0)
    for now_s, action, form in ((1.5, "none", "none"), (2.0, "hold", "hold"),
                                (3.0, "return", "none"), (4.5, "land", "land")):  # fmt: skip
        inbox.receive_ground(newer(STATE, sequence=6, safety_action=action), ANYBODY, now_s)
        # The last one that was understood stays, and ground lost counts on.
        assert inbox.ground(now_s) == (STATE, now_s - 1.0)
        assert inbox.safety_request(now_s) == form
        assert "world_id = 7" in inbox.ground_refusal
    assert inbox.safety_request(7.6) == "none"
    inbox.receive_ground(
        newer(STATE, robot_safety_actions={"3": "hold", "4": "land"}), ANYBODY, 8.0
    )
    inbox.ground(8.0)
    assert inbox.safety_request(8.0) == "hold"
    again = dataclasses.replace(STATE, sequence=7)
    inbox.receive_ground(encode(again), ANYBODY, 8.5)
    assert inbox.ground(8.5) == (again, 0.0)
    assert (inbox.safety_request(8.5), inbox.ground_refusal) == ("none", "")


def test_an_older_state_that_is_not_understood_commands_nothing() -> None:
    inbox = make_inbox()
    inbox.receive_ground(encode(STATE), ANYBODY, 1.0)
    inbox.ground(1.0)
    inbox.receive_ground(newer(STATE, sequence=4, safety_action="land"), ANYBODY, 1.5)
    inbox.ground(1.5)
    assert inbox.safety_request(1.5) == "none"


def test_of_another_release_an_order_is_taken_as_far_as_it_is_understood() -> None:
    inbox = make_inbox()
    for kind in ("kill", "dock"):
        inbox.receive_order(newer(ORDER, kind=kind), ANYBODY, 0.0)
        order = inbox.order(0.0)
        assert order is not None and (order.kind, order.boot_nonce) == (kind, ORDER.boot_nonce)
    for data in (newer(ORDER, robot_id=2), newer(ORDER, boot_nonce=-1)):
        inbox.receive_order(data, ANYBODY, 0.0)
        assert inbox.order(0.0) is None
    assert inbox.not_understood_count == 1


def test_the_grounds_release_is_that_of_the_state_that_counts() -> None:
    inbox, other = make_inbox(), structs.replace(ANYBODY, release=b"abcd")
    for now_s, data, sender, release in (
        (1.0, encode(STATE), other, "61626364"),
        (1.5, encode(dataclasses.replace(STATE, sequence=4)), ANYBODY, "61626364"),
        (2.0, encode(STATE), ANYBODY, ""),
        (2.5, newer(STATE), other, "61626364"),
    ):
        inbox.receive_ground(data, sender, now_s)
        inbox.ground(now_s)
        assert inbox.other_release == release


def test_robots_of_another_version_are_named_while_they_send() -> None:
    inbox = make_inbox()
    inbox.receive_unreadable(4, 1.0)
    for now_s, robots in ((2.0, (4,)), (4.5, ())):
        assert inbox.unreadable_robots(now_s) == robots


def test_robots_that_the_ground_receives_and_this_robot_does_not() -> None:
    inbox, table = make_inbox(), NeighbourTable(3)

    def missing(now_s: float, *named: int, heard: bool = False) -> tuple[int, ...]:
        """Robots missing once the ground has named these."""
        state = dataclasses.replace(STATE, echoes={str(r): Echo(1, 1.0, 0.0) for r in named})
        inbox.receive_ground(encode(state), ANYBODY, now_s)
        inbox.ground(now_s)
        if heard:
            table.receive(NEIGHBOUR, (1, int(now_s * 10.0)), None, now_s, None)
        inbox.unreadable_robots(now_s)
        return inbox.missing_robots(now_s, table)

    # Its program has only just begun.
    assert [missing(now_s, 2, 3) for now_s in (1.0, 2.0, 4.0, 5.9)] == [()] * 4
    assert missing(6.1, 2, 3) == (2,)
    assert missing(7.0, 2, 3, heard=True) == ()
    assert missing(11.9, 2) == ()
    assert missing(12.1, 2) == (2,)
    # Another one's turn; this one's comes after a while, also from a ground that was away.
    assert missing(20.0, 3) == (2,)
    assert missing(30.0, 2) == (2,)
    # Who speaks another version says what is wrong itself.
    inbox.receive_unreadable(2, 30.1)
    assert missing(30.2, 2) == ()
    # Its program ends: neither the ground hears it, nor this robot.
    assert missing(40.0, 2, heard=True) == ()
    assert [missing(now_s, 3) for now_s in (42.0, 50.0, 60.1, 70.0)] == [()] * 4
    # It starts again, and is given the same time.
    assert [missing(now_s, 2) for now_s in (80.0, 84.9, 85.1)] == [(), (), (2,)]


def test_only_a_hold_counts_from_stations_that_do_not_command() -> None:
    ann, bob = Sender(Role.OPERATOR, "ann"), Sender(Role.OPERATOR, "bob")
    guest = Sender(Role.OBSERVER, "guest")
    state = dataclasses.replace(STATE, operator="ann", safety_action="none")

    def asked(inbox: Inbox, now_s: float) -> tuple[str, str]:
        ground, _ = inbox.ground(now_s)
        assert ground is not None
        assert (ground.operator, ground.sequence) == ("ann", state.sequence)
        return ground.safety_action_for(3), ground.safety_action_by

    def make() -> Inbox:
        inbox = Inbox(3, 3.0)
        inbox.receive_ground(encode(state), ann, 0.9)
        return inbox

    for sender in (bob, guest):
        for hold in (Hold(sender.name), Hold(sender.name, (2, 3))):
            inbox = make()
            inbox.receive_hold(encode(hold), sender, 0.95)
            assert asked(inbox, 1.0) == ("hold", sender.name)
            # It ends with whoever says it.
            assert asked(inbox, 2.4) == ("hold", sender.name)
            assert asked(inbox, 2.5) == ("none", "")
        # Of others, in another's name, and a state that is not its operator's own.
        inbox = make()
        inbox.receive_hold(encode(Hold(sender.name, (4,))), sender, 0.95)
        inbox.receive_hold(encode(Hold("eve")), sender, 0.95)
        inbox.receive_hold(b"{}", sender, 0.95)
        for action in ("hold", "land"):
            other = dataclasses.replace(state, sequence=state.sequence + 1, safety_action=action)
            inbox.receive_ground(encode(other), sender, 0.95)
            inbox.receive_ground(newer(other), sender, 0.95)
        assert asked(inbox, 1.0) == ("none", "")
        assert inbox.safety_request(1.0) == "none"
    # What the commander asks for goes before.
    inbox = make()
    landing = dataclasses.replace(state, safety_action="land")
    inbox.receive_hold(encode(Hold("bob")), bob, 0.95)
    inbox.receive_ground(encode(landing), ann, 1.0)
    assert asked(inbox, 1.0) == ("land", "")
    assert Inbox(3, 3.0).ground(0.0)[0] is None


def test_an_order_is_its_operators_own() -> None:
    inbox = Inbox(3, 3.0)
    order = dataclasses.replace(ORDER, robot_id=3, operator="ann")
    for kind in ("takeoff", "kill"):
        data = encode(dataclasses.replace(order, kind=kind))
        inbox.receive_order(data, Sender(Role.OPERATOR, "bob"), 0.0)
        inbox.receive_order(data, Sender(Role.OBSERVER, "ann"), 0.0)
        assert inbox.order(0.0) is None
        inbox.receive_order(data, Sender(Role.OPERATOR, "ann"), 0.0)
        assert inbox.order(0.0) == dataclasses.replace(order, kind=kind)
