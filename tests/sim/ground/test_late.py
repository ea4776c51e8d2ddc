"""What comes late counts as late, whenever it begins to, and nobody's wall clock is asked."""

from dataclasses import replace

import pytest

from edge.messages.codes import CheckCode, ReasonCode
from edge.messages.mission import FlightState
from lpac.ground.station.protocol import Enable, SetOrigin
from lpac.sim.fleet.layout import ORIGIN
from tests.said import codes
from tests.sim.ground.field import Field, FieldRobot, a_field


def heard_by(robot: FieldRobot) -> set[str]:
    return set(robot.said.neighbour_ages_s)


def delay(field: Field, delay_s: float) -> None:
    field.air = replace(field.air, delay_s=delay_s)


def test_a_neighbour_that_becomes_late_is_never_believed_fresh_again() -> None:
    field = a_field(2, "flying")
    first = field.robots[0]
    assert heard_by(first) == {"1"}
    delay(field, 1.7)
    # What was on its way comes in time.
    field.run(3.0)
    for _ in range(60):
        field.run(0.5)
        assert heard_by(first) == set()
    assert first.said.message_counts["stale"] > 20
    assert field.states() == {FlightState.MISSION}, [r.said.reason for r in field.robots]
    delay(field, 0.0)
    field.until(lambda: heard_by(first) == {"1"}, 15.0)


@pytest.mark.parametrize("delay_s", [6.0, 10.0])
def test_a_ground_that_comes_late_is_lost(delay_s: float) -> None:
    field = a_field(2, "flying")
    delay(field, delay_s)
    field.until(lambda: all(r.said.reason.code is ReasonCode.GROUND_LOST for r in field.robots))
    assert field.states() <= {FlightState.HOLD, FlightState.LAND, FlightState.LANDED}


def test_who_hears_its_ground_late_from_the_start_does_not_take_off() -> None:
    field = a_field(1, "standing")
    delay(field, 2.0)
    field.begin(SetOrigin(ORIGIN))
    field.begin(Enable())
    field.run(20.0)
    assert CheckCode.TIME_NOT_KNOWN in codes(field.robots[0].said.failed_checks)
    delay(field, 0.0)
    field.until(lambda: field.robots[0].said.ready, 20.0)


@pytest.mark.parametrize("step_s", [3600.0, -3600.0])
def test_a_wall_clock_that_is_stepped_in_flight_changes_nothing(step_s: float) -> None:
    field = a_field(2, "flying", secure=True)
    field.fleet.schedule.epoch_s += step_s
    for _ in range(40):
        field.run(0.25)
        assert heard_by(field.robots[0]) == {"1"}
        assert field.states() == {FlightState.MISSION}
    # Nor does it matter to a program that starts by it, while others remember the old time.
    field.robots[1].program.stop()
    field.until(lambda: heard_by(field.robots[0]) == set())
    field.robots[1].program.start()
    field.until(lambda: heard_by(field.robots[0]) == {"1"}, 60.0)


def test_a_ground_that_takes_over_leaves_robots_blind_for_a_moment_only() -> None:
    field = a_field(2, "flying")
    field.join("bob")
    field.run(2.0)
    field.stations["bob"].election.take_command()
    blind = 0
    for _ in range(50):
        field.run(0.1)
        blind += heard_by(field.robots[0]) == set()
    assert blind <= 10 and field.operators() == {"bob"}
