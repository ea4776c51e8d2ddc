"""What a fleet with keys makes of whoever is on its radio without one, or with a robot's."""

import secrets
from collections.abc import Callable
from dataclasses import replace

import pytest

from edge.identity.card import Role
from edge.messages.codec import encode
from edge.messages.mission import FlightState, Order, RobotStatus
from edge.messages.topics import ORDER, REVOKED, STATE, STATUS, Topic
from lpac.ground.station.protocol import SafetyCommand
from tests.flown import FlownRobot
from tests.sim.ground.field import Field, a_field

_S = FlightState
# On the radio, as a ground and as a robot.
ENEMY, TWIN = -50, 0

Seal = Callable[[Topic, bytes], bytes]


def status_of(robot: FlownRobot) -> RobotStatus:
    assert robot.program.status is not None
    return robot.program.status


def attack(field: Field, seal: Seal) -> None:
    """All robots are killed and landed in the operator's name; robot 0 is said to be another's."""
    ground, robot = (field.fleet.radio.link(station, {}) for station in (ENEMY, TWIN))
    state = field.stations["alice"].published_state()
    assert state is not None
    for each in field.robots:
        status = status_of(each)
        order = Order(
            secrets.token_hex(4), each.robot_id, status.boot_nonce, "kill",
            status.uptime_s + 5.0, "alice",
        )  # fmt: skip
        ground.publish(ORDER, seal(ORDER, encode(order)))
    lands = replace(state, sequence=state.sequence + 1, safety_action="land")
    ground.publish(STATE, seal(STATE, encode(lands)))
    told: RobotStatus = replace(
        status_of(field.robots[0]), sequence=10**6, operator="mallory", obeyed_sequence=2**48
    )
    robot.publish(STATUS, seal(STATUS, encode(told)))
    for link in (ground, robot):
        link.close()
    field.run(3.0)


def as_it_is(_: Topic, data: bytes) -> bytes:
    return data


def test_without_keys_anybody_kills_the_fleet() -> None:
    field = a_field(2, "flying")
    attack(field, as_it_is)
    assert not any(status_of(robot).armed for robot in field.robots)


@pytest.mark.parametrize("with_the_key_of", ["nobody", "robot 1", "an observer"])
def test_with_keys_nobody_else_commands_it(with_the_key_of: str) -> None:
    field = a_field(2, "flying", secure=True)
    members = field.fleet.members
    assert members is not None
    if with_the_key_of == "nobody":
        seal: Seal = as_it_is
    else:
        role, name, robot_id = (
            (Role.ROBOT, "r1", 1) if with_the_key_of == "robot 1" else (Role.OBSERVER, "eve", None)
        )
        seal = members.guard(role, name, robot_id, 10**9, lambda: 0.0).seal
    attack(field, seal)
    assert field.states() == {_S.MISSION}
    assert {status_of(robot).operator for robot in field.robots} == {"alice"}
    assert field.stations["alice"].commands
    assert field.do(SafetyCommand("hold")).done
    assert field.states() == {_S.HOLD}


def test_who_is_revoked_is_heard_no_more() -> None:
    field = a_field(2, "flying", secure=True)
    fleet = field.fleet
    assert fleet.members is not None
    assert status_of(field.robots[0]).neighbour_ages_s.keys() == {"1"}
    revoked = fleet.members.revoke(Role.ROBOT, "r1")
    fleet.radio.link(ENEMY, {}).publish(REVOKED, revoked)
    field.run(3.0)
    assert status_of(field.robots[0]).neighbour_ages_s.keys() == set()
    assert status_of(field.robots[1]).neighbour_ages_s.keys() == {"0"}
