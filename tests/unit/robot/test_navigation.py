"""From the autopilot's local frame to the mission and back, and when nothing is known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from edge.core.frames import MissionFrame
from edge.core.position import PositionJudgement, PositionLimits, PositionQuality
from edge.core.vehicle import (
    Action,
    GlobalOrigin,
    Position,
    Setpoint,
    VehicleState,
    Velocity,
)
from edge.flight.guidance import MissionPosition, MissionVelocity
from edge.robot.navigation import MAX_POSITION_AGE_S, Navigation

FRAME = MissionFrame(39.95, -75.16, math.radians(30.0))
VEHICLE = VehicleState(
    connected=True,
    position_local_m=(3.0, 4.0, -5.0),
    velocity_local_m_s=(1.0, 0.0, -0.5),
    position_at_s=100.0,
    origin=GlobalOrigin(39.95, -75.16, 12.0),
)


class Standing:
    """An autopilot that only tells its state."""

    def __init__(self, state: VehicleState) -> None:
        self.vehicle = state

    def state(self) -> VehicleState:
        return self.vehicle

    def send(self, setpoint: Setpoint) -> Setpoint | None:
        raise NotImplementedError

    def command(self, action: Action) -> None:
        raise NotImplementedError


def navigation(vehicle: VehicleState = VEHICLE, now_s: float = 100.1) -> Navigation:
    made = Navigation(Standing(vehicle), lambda: now_s, PositionLimits())
    made.frame, made.position = FRAME, PositionJudgement(quality=PositionQuality.GOOD, cause=None)
    return made


def test_the_position_is_the_mission_frames_and_its_height_the_takeoff_points() -> None:
    made = navigation()
    odometry = made.odometry()
    assert odometry is not None
    sin, cos = math.sin(FRAME.heading_rad), math.cos(FRAME.heading_rad)
    x_m, y_m = -sin * 3.0 + cos * 4.0, cos * 3.0 + sin * 4.0
    np.testing.assert_allclose(odometry.position_m, (x_m, y_m, 0.0), atol=1e-9)
    np.testing.assert_allclose(odometry.velocity_m_s, (-sin, cos, 0.5), atol=1e-9)
    made.datum_m = 2.0
    above = made.odometry()
    assert above is not None and above.position_m[2] == pytest.approx(15.0)
    estimate = made.estimate(VEHICLE)
    assert estimate is not None and estimate.position_m[2] == pytest.approx(17.0)


@pytest.mark.parametrize(
    "change",
    [
        {"position_local_m": None},
        {"velocity_local_m_s": None},
        # It may be in the air, and its takeoff point is not known.
        {"armed": True},
        {"origin": None},
        {"position_at_s": 100.1 - MAX_POSITION_AGE_S - 0.01},
    ],
)
def test_without_a_fresh_trusted_position_there_is_none(change: dict[str, object]) -> None:
    vehicle = structs.replace(VEHICLE, **change)
    assert navigation(vehicle).odometry() is None


def test_without_a_mission_frame_there_is_no_position_and_no_setpoint() -> None:
    made = navigation()
    made.frame = None
    assert made.odometry() is None
    assert made.to_local(MissionVelocity((1.0, 0.0, 0.0)), VEHICLE) is None


def test_a_position_without_takeoff_height_is_not_flown() -> None:
    assert navigation().to_local(MissionPosition((1.0, 2.0, 3.0)), VEHICLE) is None


def test_a_place_is_not_flown_to_while_positions_are_missing() -> None:
    made = navigation(now_s=100.3)
    made.datum_m = 0.0
    there = MissionPosition((1.0, 2.0, 3.0))
    assert made.to_local(there, VEHICLE) == Velocity((0.0, 0.0, 0.0))


place = st.tuples(*[st.floats(-100.0, 100.0)] * 3)


@given(place, st.floats(-20.0, 20.0))
def test_a_setpoint_at_the_robots_own_place_is_where_the_vehicle_is(
    position_local_m: tuple[float, float, float], datum_m: float
) -> None:
    """Also where the estimator's origin is away from the mission's."""
    vehicle = structs.replace(
        VEHICLE,
        position_local_m=position_local_m,
        origin=GlobalOrigin(39.951, -75.162, 30.0),
    )
    made = navigation(vehicle)
    made.datum_m = datum_m
    odometry = made.odometry()
    assert odometry is not None
    back = made.to_local(MissionPosition(odometry.position_m), vehicle)
    assert isinstance(back, Position)
    np.testing.assert_allclose(back.position_local_m, position_local_m, atol=1e-6)
    velocity = made.to_local(MissionVelocity(odometry.velocity_m_s), vehicle)
    assert isinstance(velocity, Velocity)
    np.testing.assert_allclose(velocity.velocity_local_m_s, (1.0, 0.0, -0.5), atol=1e-9)


def test_when_the_estimators_origin_moves_the_position_stays() -> None:
    """The same place on earth, and the same height, told from another origin."""
    made = navigation()
    made.datum_m = 2.0
    before = made.odometry()
    moved_deg = FRAME.to_global_deg(0.0, 7.0)
    north_m, east_m = 7.0 * math.cos(FRAME.heading_rad), 7.0 * math.sin(FRAME.heading_rad)
    moved = structs.replace(
        VEHICLE,
        origin=GlobalOrigin(*moved_deg, 18.0),
        position_local_m=(3.0 - north_m, 4.0 - east_m, 1.0),
    )
    made._vehicle = Standing(moved)
    after = made.odometry()
    assert before is not None and after is not None
    np.testing.assert_allclose(after.position_m, before.position_m, atol=1e-4)
    # From a mission a metre to the right it lies a metre to the left.
    made.frame = MissionFrame(*FRAME.to_global_deg(1.0, 0.0), FRAME.heading_rad)
    beside = made.odometry()
    assert beside is not None
    np.testing.assert_allclose(after.position_m, np.add(beside.position_m, (1, 0, 0)), atol=1e-4)


def test_latitude_and_longitude_need_no_mission() -> None:
    made = navigation()
    made.frame = None
    place_deg = made.global_deg(VEHICLE)
    assert place_deg is not None
    # Seen from a mission that starts there, the estimator's origin is as far away.
    back = MissionFrame(*place_deg, 0.0).relative_to(39.95, -75.16)
    np.testing.assert_allclose(back.local_origin_m, (-4.0, -3.0, 0.0), atol=1e-5)


@pytest.mark.parametrize(
    "change",
    [
        {"origin": None},
        {"position_local_m": None},
        {"position_at_s": 100.1 - MAX_POSITION_AGE_S - 0.01},
    ],
)
def test_without_a_fresh_position_there_is_no_latitude(change: dict[str, object]) -> None:
    vehicle = structs.replace(VEHICLE, **change)
    assert navigation(vehicle).global_deg(vehicle) is None
