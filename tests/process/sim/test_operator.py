"""The scripted ground station, against robots that only talk."""

import dataclasses
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from unittest.mock import patch

import pytest

from edge.core.fence import Fence
from edge.drivers.zenoh_link import ZenohLink
from edge.messages.codec import decode, encode
from edge.messages.codes import Refusal, RefusalCode
from edge.messages.mission import (
    FlightState,
    GroundState,
    Order,
    OrderResult,
    Origin,
    Place,
    RobotStatus,
    world_id,
)
from edge.messages.topics import ORDER, STATE, STATUS, WORLD
from lpac.sim.operator import Operator, OperatorScript, OperatorScriptError
from lpac.sim.ports import free_ports
from tests.said import reason

ORIGIN = Origin(40.0, -75.0, 30.0)
SAID = RobotStatus(
    robot_id=0, boot_nonce=7, sequence=0, uptime_s=100.0, unix_time_s=0.0, state=FlightState.HOLD,
    reason=reason(""), ready=False, failed_checks=(), alarms=(), obeyed_sequence=0, operator="",
    orders=(),
    bundle_id="", world_id="", trial="", origin=None, system_id=1, slot_height_m=4.0,
    landing_point_m=(0.0, 0.0), position_m=(0.0, 0.0, 4.0), velocity_m_s=None, heading_rad=None,
    mode=None, armed=True, battery=None, satellites=None, message_counts={}, neighbour_ages_s={},
    loops={},
)  # fmt: skip


class Talker:
    """A robot's radio: says what the test wants, and keeps what the ground says."""

    def __init__(self, endpoint: str, robot: int) -> None:
        self._changed = threading.Condition()
        self.states: list[GroundState] = []
        self.orders: list[Order] = []
        self.worlds: list[str] = []
        self.status = dataclasses.replace(SAID, robot_id=robot)
        self.link = ZenohLink(
            fleet="test", robot_id=robot, listen=(endpoint,),
            subscriptions={
                STATE: self._on_state, ORDER: self._on_order,
                WORLD: self._on_world,
            },
        )  # fmt: skip

    def say(self, **changes: object) -> None:
        self.status = dataclasses.replace(self.status, **changes)  # type: ignore[arg-type]
        self.link.publish(STATUS, encode(self.status))

    def wait_for(self, condition: Callable[[], bool]) -> None:
        with self._changed:
            assert self._changed.wait_for(condition, 60.0), (self.states, self.orders)

    def _on_state(self, _: str, data: bytes) -> None:
        with self._changed:
            self.states.append(decode(GroundState, data))
            self._changed.notify_all()

    def _on_world(self, _: str, data: bytes) -> None:
        with self._changed:
            self.worlds.append(data.decode())
            self._changed.notify_all()

    def _on_order(self, _: str, data: bytes) -> None:
        with self._changed:
            self.orders.append(decode(Order, data))
            self._changed.notify_all()


@contextmanager
def talking(
    robots: int = 1, *, lifetime_s: float = 600.0
) -> Iterator[tuple[Operator, list[Talker]]]:
    """An operator that hears the robots' first statuses, which count for `lifetime_s`."""
    endpoints = [f"tcp/127.0.0.1:{port}" for port in free_ports(robots)]
    talkers = [Talker(endpoint, robot) for robot, endpoint in enumerate(endpoints)]
    try:
        with (
            patch("lpac.sim.operator.STATUS_LIFETIME_S", lifetime_s),
            Operator(fleet="test", connect=endpoints) as operator,
        ):

            def heard(statuses: object) -> bool:
                for talker in talkers:
                    talker.say()
                return len(operator.statuses()) == robots

            assert operator.wait_for(heard, 60.0)
            yield operator, talkers
    finally:
        for talker in talkers:
            talker.link.close()


def answered(operator: Operator, robot: Talker, order_id: str, **answer: object) -> OrderResult:
    """What becomes of an order that the robot answers, as often as it takes."""

    def settled(_: object) -> bool:
        robot.say(**answer)
        return operator.result(order_id) is not None

    assert operator.wait_for(settled, 60.0)
    result = operator.result(order_id)
    assert result is not None
    return result


def test_an_order_is_repeated_until_it_is_answered() -> None:
    with talking() as (operator, [robot]):
        order_id = operator.order("start", 0, "trial")
        robot.wait_for(lambda: len(robot.orders) >= 3)
        assert len(set(robot.orders)) == 1
        order = robot.orders[0]
        assert (order.order_id, order.robot_id, order.boot_nonce) == (order_id, 0, 7)
        assert (order.kind, order.trial, order.expires_at_uptime_s) == ("start", "trial", 110.0)
        assert operator.ordered(0) and operator.result(order_id) is None
        accepted = OrderResult(order_id)
        assert answered(operator, robot, order_id, orders=(accepted,)) == accepted
        assert not operator.ordered(0) and operator.refusals == []


@pytest.mark.parametrize(
    ("answer", "code"),
    [
        ({"orders": ()}, RefusalCode.NOT_READY),
        ({"uptime_s": 110.5}, RefusalCode.NOT_ANSWERED),
        ({"boot_nonce": 8, "uptime_s": 3.0}, RefusalCode.NOT_ANSWERED),
    ],
    ids=["refused", "expired", "restarted"],
)
def test_what_becomes_of_an_order_that_is_not_taken(
    answer: dict[str, object], code: RefusalCode
) -> None:
    with talking() as (operator, [robot]):
        order_id = operator.order("takeoff", 0)
        if "orders" in answer:
            answer = {"orders": (OrderResult(order_id, Refusal(code, "no GPS")),)}
        refusal = answered(operator, robot, order_id, **answer).refusal
        assert refusal is not None and refusal.code is code
        refusals = [f"robot 0 refuses takeoff: {refusal.text}"]
        # Kept a moment after the result.
        assert operator.wait_for(lambda _: operator.refusals == refusals, 60.0)


def test_nobody_orders_a_robot_that_is_not_heard() -> None:
    with talking() as (operator, _):
        result = operator.result(operator.order("takeoff", 5))
        assert result is not None and result.refusal is not None
        assert result.refusal.code is RefusalCode.NOT_ANSWERED


def test_the_state_is_repeated_and_its_sequence_grows_with_each_change() -> None:
    with talking() as (operator, [robot]):
        assert robot.states == []  # a ground that wants nothing says nothing
        operator.enable(ORIGIN)
        robot.wait_for(lambda: len(robot.states) >= 2)
        operator.enable(ORIGIN)
        operator.safety_action("return", 3)
        operator.safety_action("hold", 4)
        robot.wait_for(lambda: bool(robot.states[-1].robot_safety_actions.get("4")))
        state = robot.states[-1]
        assert state.enabled and state.origin == ORIGIN and state.unix_time_s is not None
        assert [state.safety_action_for(robot) for robot in (0, 3, 4)] == ["none", "return", "hold"]
        assert (robot.states[0].sequence, state.sequence) == (1, 3)
        operator.safety_action("land")
        robot.wait_for(lambda: robot.states[-1].safety_action_for(3) == "land")


def test_what_flights_go_by_is_said_and_the_world_sent_while_somebody_lacks_it() -> None:
    world = "CircularBND 1 2 3 4\n"
    fence = Fence(((0.0, 0.0), (32.0, 0.0), (32.0, 32.0)), 2.0, 1.0, 30.0)
    place = Place(2, (8.0, 8.0))
    with talking() as (operator, [robot]):
        operator.assign(fence=fence, places={0: place}, world=world)

        def sent() -> bool:
            robot.say()
            return len(robot.worlds) >= 2

        assert operator.wait_for(lambda _: sent(), 60.0)
        state = robot.states[-1]
        assert (state.fence, state.places, state.world_id) == (fence, {"0": place}, world_id(world))
        assert set(robot.worlds) == {world}
        operator.assign()
        robot.wait_for(lambda: robot.states[-1].fence is None)
        assert (robot.states[-1].places, robot.states[-1].world_id) == ({}, None)


def test_who_is_held_up_tries_again_until_heights_have_walked() -> None:
    up = {"state": FlightState.HOLD, "position_m": (0.0, 0.0, 4.0)}
    with talking(2) as (operator, [robot, low]):

        def say(first_s: float) -> None:
            robot.say(flown_s=first_s, **up)
            low.say(flown_s=first_s - 2.0, **up | {"position_m": (0.0, 0.0, 1.0)})
            assert operator.wait_for(lambda s: {first_s} <= {s[0].flown_s, s[1].flown_s}, 60.0)
            assert operator.wait_for(lambda s: s[1].flown_s == first_s - 2.0, 60.0)

        script = OperatorScript(operator, robots=range(2), origin=ORIGIN, mission_s=1.0, trial="t")
        takeoff = next(step for step in script.steps if step.name == "takeoff")
        say(49.0)
        takeoff.act()
        low.wait_for(lambda: bool(low.states))
        assert [low.states[-1].safety_action_for(robot) for robot in (0, 1)] == ["none", "land"]
        say(51.0)
        with pytest.raises(OperatorScriptError, match="robots 1 did not come to their heights"):
            takeoff.act()
        # With all at their heights nothing is late.
        low.say(**up)
        assert operator.wait_for(takeoff.done, 60.0)
        takeoff.act()


def test_a_silent_robot_is_no_longer_among_the_statuses() -> None:
    with talking(2, lifetime_s=2.0) as (operator, [_, other]):

        def only_the_other(statuses: object) -> bool:
            other.say()
            return set(operator.statuses()) == {1}

        assert operator.wait_for(only_the_other, 60.0)
        assert len(operator.history(0)) >= 1
        assert not operator.wait_for(lambda statuses: 0 in statuses, 0.1)


def test_a_robot_whose_vehicle_is_gone_is_not_waited_for() -> None:
    with talking(2) as (operator, [gone, other]):
        gone.say(state=FlightState.FAULT)
        assert operator.wait_for(lambda statuses: statuses[0].state is FlightState.FAULT, 60.0)
        script = OperatorScript(operator, robots=(0, 1), origin=ORIGIN, mission_s=0.0, trial="test")
        began_s = time.monotonic()
        script.land(lambda _: other.say(state=FlightState.LANDED, armed=False))
        assert operator.statuses()[1].state is FlightState.LANDED
        assert time.monotonic() - began_s < 30.0
