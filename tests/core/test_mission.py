"""What ground and robots say to each other survives the way, and what is wrong is named."""

import re

import pytest

from edge.core.mission import (
    FlightState,
    GroundState,
    LoopStatus,
    Order,
    OrderResult,
    Origin,
    RobotStatus,
    from_json,
    to_json,
)
from edge.core.schema import ConfigError

STATUS = RobotStatus(
    robot_id=3, boot_nonce=2**47, sequence=9, uptime_s=12.5, unix_time_s=1.8e9,
    state=FlightState.HOLD, reason="at its height", ready=False, failed_checks=("a", "b"),
    alarms=(), obeyed_sequence=4, operator="anna",
    orders=(OrderResult("1", accepted=False, reason="expired"),),
    bundle_id="ab", world_id="cd", trial="t1", origin=Origin(40.0, -75.0, 359.0), system_id=1,
    slot_height_m=8.0, landing_point_m=(1.0, 2.0), position_m=(1.0, 2.0, 3.0),
    velocity_m_s=None, heading_rad=0.1, mode="offboard", armed=True, battery=0.5, satellites=12,
    message_counts={"accepted": 4}, neighbour_ages_s={"2": 0.1},
    loops={"control": LoopStatus(1, 0, 0, 0.1, 0.2, 0.3)},
)  # fmt: skip


def test_messages_survive_the_way() -> None:
    state = GroundState(
        7, "anna", Origin(1.0, 2.0, 3.0), enabled=True, calm="hold", robot_calm={"3": "land"}
    )
    order = Order("x", 3, 2**47, "start", 22.5, "anna", trial="t1")
    for message in (state, order, STATUS):
        assert from_json(type(message), to_json(message)) == message


def test_what_is_asked_of_one_robot_overrides_what_is_asked_of_all() -> None:
    state = GroundState(7, "anna", calm="hold", robot_calm={"3": "land", "4": "none"})
    assert [state.calm_for(robot) for robot in (2, 3, 4)] == ["hold", "land", "none"]


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
