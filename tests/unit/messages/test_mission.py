"""What ground and robots say to each other survives the way, and what is wrong is named."""

import dataclasses
import json
import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.fence import Fence
from edge.core.schema import ConfigError
from edge.messages.mission import (
    FlightState,
    GroundState,
    LoopStatus,
    Order,
    OrderResult,
    Origin,
    Place,
    RobotStatus,
    explored_from_bytes,
    explored_to_bytes,
    from_json,
    to_json,
    waiting_to_land,
)

FENCE = Fence(((0.0, 0.0), (32.0, 0.0), (32.0, 32.0)), 2.0, 1.0, 30.0)
STATUS = RobotStatus(
    robot_id=3, boot_nonce=2**47, sequence=9, uptime_s=12.5, unix_time_s=1.8e9,
    state=FlightState.HOLD, reason="at its height", ready=False, failed_checks=("a", "b"),
    alarms=(), obeyed_sequence=4, operator="anna",
    orders=(OrderResult("1", accepted=False, reason="expired"),),
    bundle_id="ab", world_id="cd", trial="t1", origin=Origin(40.0, -75.0, 359.0), system_id=1,
    slot_height_m=8.0, landing_point_m=(1.0, 2.0), position_m=(1.0, 2.0, 3.0),
    velocity_m_s=None, heading_rad=0.1, mode="offboard", armed=True, battery=0.5, satellites=12,
    message_counts={"accepted": 4}, neighbour_ages_s={"2": 0.1},
    loops={"control": LoopStatus(1, 0, 0, 0.1, 0.2, 0.3)}, fence=FENCE, not_taken=("in flight",),
    in_air=True, global_deg=(40.0, -75.0), hdop=0.8, policy_velocity_m_s=(0.1, -0.2),
    feature_age_s=0.1, neighbour_messages={"2": 40}, ground_age_s=0.1, flown_s=63.5,
)  # fmt: skip


def test_messages_survive_the_way() -> None:
    state = GroundState(
        7, "anna", Origin(1.0, 2.0, 3.0), enabled=True, robot_enabled={"4": False},
        safety_action="hold",
        safety_action_by="ben", robot_safety_actions={"3": "land"}, fence=FENCE,
        places={"3": Place(2, (1.0, 2.0))}, world_id="cd", trial="t1", unix_time_s=1.8e9,
    )  # fmt: skip
    order = Order("x", 3, 2**47, "start", 22.5, "anna", trial="t1")
    for message in (state, order, STATUS):
        assert from_json(type(message), to_json(message)) == message


def test_what_an_older_program_does_not_say_is_not_known() -> None:
    told = dataclasses.asdict(STATUS)
    del told["flown_s"]
    assert from_json(RobotStatus, json.dumps(told).encode()).flown_s is None


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_not_known(number: float) -> None:
    odd = {
        "position_m": [1.0, number, 3.0], "velocity_m_s": [number, 0.0, 0.0],
        "global_deg": [number, number], "policy_velocity_m_s": [0.0, number],
        "heading_rad": number, "battery": number, "hdop": number, "feature_age_s": number,
        "ground_age_s": number, "flown_s": number,
    }  # fmt: skip
    ages_s = {"neighbour_ages_s": {"2": number, "4": 0.2}}
    data = json.dumps(dataclasses.asdict(STATUS) | odd | ages_s).encode()
    known = dataclasses.replace(STATUS, **dict.fromkeys(odd), neighbour_ages_s={"4": 0.2})  # type: ignore[arg-type]
    assert from_json(RobotStatus, data) == known


@pytest.mark.parametrize(
    "odd",
    [{"uptime_s": math.nan}, {"unix_time_s": math.inf}, {"slot_height_m": math.nan},
     {"landing_point_m": [0.0, math.nan]}],
    ids=str,
)  # fmt: skip
def test_a_status_has_a_time_and_a_place_to_go_to(odd: dict[str, object]) -> None:
    data = json.dumps(dataclasses.asdict(STATUS) | odd).encode()
    with pytest.raises(ConfigError, match=f"RobotStatus: {next(iter(odd))} = .*: must be finite"):
        from_json(RobotStatus, data)


def test_what_is_asked_of_one_robot_overrides_what_is_asked_of_all() -> None:
    state = GroundState(
        7, "anna", safety_action="hold", robot_safety_actions={"3": "land", "4": "none"}
    )
    assert [state.safety_action_for(robot) for robot in (2, 3, 4)] == ["hold", "land", "none"]
    state = GroundState(7, "anna", enabled=True, robot_enabled={"3": False, "4": True})
    assert [state.enabled_for(robot) for robot in (2, 3, 4)] == [True, False, True]


def test_what_was_explored_survives_the_way() -> None:
    explored = np.random.default_rng(0).random((64, 64)) < 0.3
    data = explored_to_bytes(explored)
    assert len(data) == 512
    np.testing.assert_array_equal(explored_from_bytes(data), explored)
    with pytest.raises(ValueError, match="explored has 511 bytes: must be 512"):
        explored_from_bytes(data[:-1])
    with pytest.raises(ValueError, match=r"shape \(63, 64\)"):
        explored_to_bytes(explored[1:])


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ('"places": {"3": {"slot": -1, "landing_point_m": [1, 2]}}', "slot = -1: must be from 0"),
        ('"places": {"3": {"slot": 1, "landing_point_m": [1]}}', "landing_point_m = [1.0]: must"),
        ('"fence": {"vertices_m": [], "buffer_m": 1, "floor_m": 1, "ceiling_m": 2}', "vertices_m"),
    ],
)
def test_what_the_ground_sets_for_a_flight_is_checked(fields: str, said: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(said)):
        from_json(GroundState, f'{{"sequence": 1, "operator": "a", {fields}}}'.encode())


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"\xff", "Order: not JSON"),
        (b"[]", "Order: expected a table"),
        (to_json(STATUS), "Order: unknown key 'sequence'; known are order_id"),
        (b'{"order_id": "a", "robot_id": "3"}', "Order: robot_id = '3': expected int"),
    ],
    ids=["bytes", "list", "other message", "wrong type"],
)
def test_what_is_wrong_is_named(data: bytes, said: str) -> None:
    with pytest.raises(ConfigError, match="^" + re.escape(said)):
        from_json(Order, data)


def test_an_origin_off_the_earth_is_named() -> None:
    with pytest.raises(ConfigError, match=r"heading_deg = 360.0: must be in \[0, 360\)"):
        from_json(
            GroundState,
            b'{"sequence": 1, "operator": "a", "origin": '
            b'{"latitude_deg": 1.0, "longitude_deg": 2.0, "heading_deg": 360.0}}',
        )


robots_in_the_air = st.dictionaries(
    st.integers(0, 9),
    st.tuples(
        st.sampled_from(
            [FlightState.HOLD, FlightState.RETURN, FlightState.LAND, FlightState.LANDED]
        ),
        st.booleans(),
    ),
    min_size=1,
)


@given(robots_in_the_air)
def test_nobody_lands_through_the_height_of_one_who_flies_home(
    robots: dict[int, tuple[FlightState, bool]],
) -> None:
    statuses = {
        robot: dataclasses.replace(STATUS, robot_id=robot, state=state, slot_height_m=4.0 + robot)
        for robot, (state, _) in robots.items()
    }
    arrived = {robot for robot, (_, there) in robots.items() if there}
    waiting = waiting_to_land(statuses, arrived)
    flying = {r for r, (s, _) in robots.items() if s in (FlightState.HOLD, FlightState.RETURN)}
    for robot in flying & arrived:
        others_below = any(other < robot for other in flying - arrived)
        assert (robot in waiting) == others_below
    assert waiting <= flying & arrived
    # Somebody can always go on.
    assert not flying or flying - waiting
