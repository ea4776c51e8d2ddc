"""What came by radio: the newest counts, what is broken is counted, nothing raises."""

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.messages.mission import GroundState, Order, Origin, to_json
from edge.robot.inbox import Inbox

STATE = GroundState(sequence=5, operator="anna", origin=Origin(40.0, -75.0, 30.0), enabled=True)
ORDER = Order("a", 3, 77, "takeoff", 12.0, "anna")


def make_inbox() -> Inbox:
    return Inbox(robot_id=3, ground_timeout_s=3.0)


def test_nothing_heard_is_infinitely_old() -> None:
    assert make_inbox().ground(10.0) == (None, math.inf)
    assert make_inbox().order() is None
    assert make_inbox().peers(10.0) == ()


def test_the_ground_state_ages_until_the_next_comes() -> None:
    inbox = make_inbox()
    inbox.put_ground(to_json(STATE), 1.0, 1e9)
    assert inbox.ground(1.5) == (STATE, 0.5)
    assert inbox.ground(3.0) == (STATE, 2.0)
    inbox.put_ground(to_json(STATE), 3.0, 1e9)
    assert inbox.ground(3.0) == (STATE, 0.0)


def test_an_older_state_that_arrives_late_does_not_count() -> None:
    inbox = make_inbox()
    inbox.put_ground(to_json(STATE), 1.0, 1e9)
    assert inbox.ground(1.0)[0] == STATE
    older = dataclasses.replace(STATE, sequence=4, safety_action="land")
    inbox.put_ground(to_json(older), 1.5, 1e9)
    assert inbox.ground(1.5) == (STATE, 0.5)


def test_a_ground_that_starts_anew_is_heard_once_the_old_one_is_lost() -> None:
    inbox = make_inbox()
    inbox.put_ground(to_json(STATE), 1.0, 1e9)
    inbox.ground(1.0)
    anew = GroundState(sequence=0, operator="ben")
    inbox.put_ground(to_json(anew), 5.0, 1e9)
    assert inbox.ground(5.0) == (anew, 0.0)


def test_of_two_grounds_the_greater_sequence_and_then_the_greater_operator_counts() -> None:
    inbox = make_inbox()

    def hear(now_s: float, *states: GroundState) -> tuple[GroundState | None, float]:
        for state in states:
            inbox.put_ground(to_json(state), now_s, 1e9)
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
    assert hear(11.9, cleo) == (took_over, pytest.approx(2.9))
    assert hear(12.1, cleo) == (cleo, 0.0)


def test_orders_for_others_are_passed_over() -> None:
    inbox = make_inbox()
    for robot_id in (1, 3, 2):
        inbox.put_order(to_json(dataclasses.replace(ORDER, robot_id=robot_id)))
    assert inbox.order() == ORDER
    assert inbox.order() is None


@given(st.binary() | st.text().map(str.encode) | st.just(b"[" * 100_000) | st.just(b"{}"))
def test_what_is_broken_is_counted_and_changes_nothing(data: bytes) -> None:
    inbox = make_inbox()
    inbox.put_ground(to_json(STATE), 1.0, 1e9)
    assert inbox.ground(1.0)[0] == STATE
    inbox.put_ground(data, 2.0, 1e9)
    inbox.put_order(data)
    inbox.put_status("robot/4/status", data, 2.0, 1e9)
    assert inbox.ground(2.0) == (STATE, 1.0)
    assert inbox.order() is None
    assert inbox.peers(2.0) == ()
    assert inbox.malformed == 3


def test_what_is_far_too_long_is_not_even_decoded() -> None:
    inbox = make_inbox()
    long = b"[" + 100_000 * b"1," + b"1]"
    inbox.put_ground(long, 1.0, 1e9)
    inbox.put_order(long)
    inbox.put_status("robot/4/status", long, 1.0, 1e9)
    inbox.put_world(20 * long)
    assert inbox.malformed == 4
    assert inbox.ground(1.0) == (None, math.inf)
    assert inbox.order() is None
    assert inbox.peers(1.0) == ()
    assert inbox.world is None
