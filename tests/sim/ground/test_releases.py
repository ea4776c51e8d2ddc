"""Programs of two releases: nobody takes off with them, and in flight nobody meets them."""

import pytest

from edge.core.wire import Rejection
from edge.messages.codes import CheckCode, RefusalCode
from edge.messages.mission import FlightState
from edge.messages.topics import MESSAGE, STATUS
from lpac.ground.alarms import AlarmCode, alarms
from lpac.ground.station.protocol import RobotCommand, SafetyCommand, Start, Takeoff
from tests.sim.ground.field import Field, FieldRobot, a_field

_S = FlightState
OTHER = b"\1\2\3\4"


def of_another_release(field: Field, robot: FieldRobot) -> None:
    node = robot.program.node
    assert node is not None
    node._guard.release = node._inbox._release = OTHER


def ground_of_another_release(field: Field) -> None:
    field.fleet.grounds["alice"].node._guard.release = OTHER


def checks(robot: FieldRobot) -> list[str]:
    return [c.text for c in robot.said.failed_checks if c.code is CheckCode.OTHER_RELEASE]


def alarms_of(field: Field, name: str) -> set[AlarmCode]:
    ground = field.fleet.grounds["alice"]
    return {alarm.code for alarm in alarms(ground.setup, ground.snapshot) if alarm.robot == name}


@pytest.mark.parametrize("secure", [False, True])
def test_nobody_takes_off_beside_a_robot_of_another_release(secure: bool) -> None:
    field = a_field(2, "ready", secure=secure)
    one, other = field.robots
    of_another_release(field, other)
    field.until(lambda: checks(one) and checks(other), 5.0)
    assert checks(one) == [
        "robot 1 flies another release (01020304) than this robot: deploy one to all"
    ]
    assert len(checks(other)) == 2, "the robot's, and the ground's"
    field.until(lambda: AlarmCode.OTHER_RELEASE in alarms_of(field, "r1"), 5.0)
    assert AlarmCode.OTHER_RELEASE not in alarms_of(field, "r0")
    assert not field.do(Takeoff()).done
    assert not any(robot.said.armed for robot in field.robots)


def test_in_flight_it_is_kept_clear_of_and_its_policy_is_not_heard() -> None:
    field = a_field(2, "flying")
    one, other = field.robots
    node = one.program.node
    assert node is not None
    of_another_release(field, other)
    field.run(2.0)
    assert node._pac.table.neighbours(field.now_s) == ()
    assert node._pac.table.counts()[Rejection.OTHER_RELEASE] > 0
    (told,) = node._control._neighbours(node._pac.table.beacons(field.now_s, 1.0), field.now_s)
    assert told.robot_id == 1
    assert field.states() == {_S.MISSION}
    # It is brought down as the others are.
    assert field.do(SafetyCommand("hold")).done
    assert field.states() == {_S.HOLD}
    assert field.do(SafetyCommand("land")).done
    field.until(lambda: field.states() == {_S.LANDED})


def test_a_ground_of_another_release_holds_lands_and_kills_and_starts_nothing() -> None:
    field = a_field(2, "hovering")
    ground_of_another_release(field)
    field.run(1.0)
    assert not field.do(Start()).done
    answers = [a.refusal for robot in field.robots for a in robot.said.orders if a.refusal]
    assert RefusalCode.OTHER_RELEASE in {refusal.code for refusal in answers}
    assert field.do(SafetyCommand("land", robots=("r0",))).done
    field.until(lambda: field.robots[0].said.state is _S.LANDED)
    assert not field.do(Takeoff(robots=("r0",))).done
    assert field.robots[1].said.state is _S.HOLD
    assert field.do(RobotCommand("kill", robots=("r1",))).done
    field.until(lambda: not field.robots[1].said.armed, 5.0)


def test_who_speaks_in_envelopes_of_another_version_is_named() -> None:
    field = a_field(2, "ready")
    one, other = field.robots
    link = field.fleet.radio.link(1, {})
    node = other.program.node
    assert node is not None
    for topic in (MESSAGE, STATUS):
        said = bytearray(node._guard.seal(topic, b""))
        said[2] += 1
        link.publish(topic, bytes(said))
    link.close()
    field.until(lambda: checks(one), 5.0)
    assert checks(one) == [
        "robot 1 flies another release (not readable) than this robot: deploy one to all"
    ]
    field.until(lambda: any("cannot read" in event.text for event in field.events), 5.0)
    field.until(lambda: not checks(one), 10.0)
