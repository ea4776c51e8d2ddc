"""What a fleet makes of lists of members that differ, and of programs that start again."""

from dataclasses import replace

import pytest

from edge.identity.guard import SignedGuard
from edge.identity.members import Members
from edge.messages.codes import CheckCode, ReasonCode
from edge.messages.mission import FlightState, RobotStatus
from edge.messages.topics import STATE
from lpac.ground.alarms import AlarmCode, alarms
from lpac.ground.station.protocol import Resume, SafetyCommand, Start, Takeoff
from tests.flown import FlownRobot
from tests.sim.ground.field import Field, a_field


def status_of(robot: FlownRobot) -> RobotStatus:
    assert robot.program.status is not None
    return robot.program.status


def guard_of(robot: FlownRobot) -> SignedGuard:
    assert robot.program.node is not None
    guard = robot.program.node._guard
    assert isinstance(guard, SignedGuard)
    return guard


def a_later_list(field: Field) -> Members:
    assert field.fleet.members is not None
    now = field.fleet.members.list
    return replace(now, number=now.number + 1)


def failed(robot: FlownRobot) -> dict[CheckCode, str]:
    return {check.code: check.text for check in status_of(robot).failed_checks}


def told_by(robot: FlownRobot) -> set[ReasonCode]:
    return {alarm.code for alarm in status_of(robot).alarms}


def alarms_at(field: Field) -> dict[AlarmCode, str]:
    alice = field.stations["alice"]
    found = alarms(alice.setup, alice.snapshot())
    return {alarm.code: alarm.text for alarm in found if not alarm.robot}


def test_robots_whose_lists_differ_do_not_take_off_until_all_have_one() -> None:
    field = a_field(2, "ready", secure=True)
    assert AlarmCode.MEMBERS_DIFFER not in alarms_at(field)
    later = a_later_list(field)
    first, second = field.robots
    guard_of(first).update_members(later)
    field.run(3.0)
    # From the ground's, and from a neighbour's.
    number = later.number
    for robot, text in (
        (first, f"the list of members here is {number}, and r1 has {number - 1}, which is older"),
        (second, f"the list of members here is {number - 1}, and r0 has {number}, which is newer"),
    ):
        assert failed(robot)[CheckCode.MEMBERS_DIFFER].startswith(text)
        assert ReasonCode.MEMBERS_DIFFER in told_by(robot)
        assert "`lpac fleet up`" in failed(robot)[CheckCode.MEMBERS_DIFFER]
    assert f"r0 has {number}, which is newer" in alarms_at(field)[AlarmCode.MEMBERS_DIFFER]
    assert not field.do(Takeoff()).done
    assert not any(status_of(robot).armed for robot in field.robots)
    ground = field.fleet.grounds["alice"].node._guard
    for guard in (ground, guard_of(second)):
        assert isinstance(guard, SignedGuard)
        guard.update_members(later)
    field.run(6.0)
    assert not any(failed(robot) for robot in field.robots)
    assert AlarmCode.MEMBERS_DIFFER not in alarms_at(field)
    assert field.do(Takeoff()).done


def test_in_flight_another_list_changes_nothing_and_is_told() -> None:
    field = a_field(2, "flying", secure=True)
    first, second = field.robots
    guard_of(first).update_members(a_later_list(field))
    field.run(6.0)
    assert field.states() == {FlightState.MISSION}
    assert [set(status_of(robot).neighbour_ages_s) for robot in field.robots] == [{"1"}, {"0"}]
    assert all(ReasonCode.MEMBERS_DIFFER in told_by(robot) for robot in (first, second))
    assert field.do(SafetyCommand("hold")).done
    assert field.states() == {FlightState.HOLD}
    # A mission, too, begins with it.
    field.done(Resume())
    field.done(Start())


@pytest.mark.parametrize("starts", ["ground", "robot"])
def test_a_program_that_starts_again_is_heard_at_once(starts: str) -> None:
    field = a_field(2, "flying" if starts == "ground" else "ready", secure=True)
    first = field.robots[0]
    if starts == "ground":
        field.restart("alice", away_s=0.0)
        field.run(1.0)
        alice = field.stations["alice"]
        assert all(alice.recent_status(name) is not None for name in ("r0", "r1"))
        # It says nothing before it has heard how the fleet is.
        field.until(alice.published_state, 1.0)
        field.run(0.5)
        for robot in field.robots:
            age_s = status_of(robot).ground_age_s
            assert age_s is not None and age_s < 1.5 / STATE.rate_hz
            assert "unknown_key" not in status_of(robot).message_counts
    else:
        field.fleet.robots[1].start()
        key = guard_of(field.robots[1])._own.fingerprint, "robot/1/status"
        ground = field.fleet.grounds["alice"].node._guard
        assert isinstance(ground, SignedGuard)
        field.run(0.1)
        heard_s = field.now_s
        field.until(lambda: ground._streams[key].newest_s >= heard_s, 1.0)
        assert "unknown_key" not in status_of(first).message_counts
