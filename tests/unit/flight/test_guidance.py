"""Setpoints of each flight state, flown by a vehicle that follows them late."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import structs

from edge.core import F64
from edge.core.fence import Fence
from edge.core.ports import Odometry
from edge.core.position import PositionJudgement, PositionQuality
from edge.core.vehicle import Vector, VehicleState
from edge.flight.guidance import (
    Guidance,
    MissionPosition,
    MissionSetpoint,
    MissionVelocity,
    guide,
)
from edge.flight.lift import Lift
from edge.flight.safety import MotionLimits
from edge.flight.state import FlightInputs, FlightMemory, FlightParameters, Robot
from edge.messages.beacon import Neighbour
from edge.messages.mission import FlightState

TICK_S = 0.1
ZERO_M = -3.0  # The takeoff point, from the estimator's zero.
ROBOT = Robot(
    robot_id=3,
    boot_nonce=77,
    parameters=FlightParameters(slot=1, landing_point_m=(10.0, 12.0)),
    fence=Fence(((0.0, 0.0), (32.0, 0.0), (32.0, 32.0), (0.0, 32.0)), 2.0, 1.0, 30.0),
    limits=MotionLimits(2.0, 1.0, 1.5, 1.3),
)
SLOT_M = ROBOT.parameters.slot_height_m
AT_SLOT: Vector = (16.0, 16.0, SLOT_M)
STILL: Vector = (0.0, 0.0, 0.0)


def flight(state: FlightState, target_m: Vector | None = None) -> FlightMemory:
    return FlightMemory(state=state, datum_m=ZERO_M, target_m=target_m)


def inputs(
    position_m: Vector | None = AT_SLOT,
    velocity_m_s: Vector = STILL,
    policy_m_s: F64 | None = None,
    neighbours: tuple[Neighbour, ...] = (),
    quality: PositionQuality = PositionQuality.GOOD,
) -> FlightInputs:
    odometry = None
    if position_m is not None:
        x_m, y_m, height_m = position_m
        odometry = Odometry((x_m, y_m, height_m + ZERO_M), velocity_m_s)
    return FlightInputs(
        now_s=100.0,
        vehicle=VehicleState(),
        position=PositionJudgement(quality=quality, cause=None),
        odometry=odometry,
        policy_velocity_m_s=policy_m_s,
        neighbours=neighbours,
        closest=None,
        busy_neighbours=(),
        ground=None,
        ground_age_s=0.0,
        safety_request="none",
        failed_checks=(),
        not_taken=(),
        order=None,
        uptime_s=50.0,
        energy=None,
    )


def setpoint(state: FlightMemory, given: FlightInputs) -> MissionSetpoint | None:
    return guide(ROBOT, state, given, Guidance(), TICK_S)[0]


def position(state: FlightMemory, given: FlightInputs) -> F64:
    sent = setpoint(state, given)
    assert isinstance(sent, MissionPosition)
    return np.array(sent.position_m)


class Vehicle:
    """Answers a velocity with the lag of PX4's offboard mode, a position with 0.95 of it per s."""

    def __init__(self, position_m: Vector) -> None:
        self.position_m = np.array(position_m)
        self.velocity_m_s = np.zeros(3)
        self.path_m: list[F64] = []

    def fly(
        self,
        state: FlightMemory,
        seconds: float,
        policy_m_s: F64 | None = None,
        neighbours: tuple[Neighbour, ...] = (),
        ground_age_s: float = 0.0,
    ) -> None:
        memory = Guidance()
        for _ in range(round(seconds / TICK_S)):
            x, y, z = self.position_m.tolist()
            vx, vy, vz = self.velocity_m_s.tolist()
            given = inputs((x, y, z), (vx, vy, vz), policy_m_s, neighbours)
            given = structs.replace(given, ground_age_s=ground_age_s)
            sent, memory = guide(ROBOT, state, given, memory, TICK_S)
            assert sent is not None
            self.follow(sent)

    def follow(self, sent: MissionSetpoint) -> None:
        """For one tick."""
        if isinstance(sent, MissionPosition):
            wanted_m_s, lag_s = 0.95 * (np.array(sent.position_m) - self.position_m), 0.3
        else:
            wanted_m_s, lag_s = np.array(sent.velocity_m_s), ROBOT.limits.lag_s
        self.velocity_m_s += (wanted_m_s - self.velocity_m_s) * (TICK_S / lag_s)
        self.position_m = self.position_m + self.velocity_m_s * TICK_S
        self.path_m.append(self.position_m)


@pytest.mark.parametrize(
    "state", sorted(set(FlightState) - {"arming", "takeoff", "hold", "mission", "return"})
)
def test_nothing_is_sent_where_the_robot_does_not_steer(state: FlightState) -> None:
    assert setpoint(flight(state, AT_SLOT), inputs(policy_m_s=np.ones(2))) is None


def test_nothing_is_sent_right_after_a_lapse() -> None:
    silent = structs.replace(flight(FlightState.HOLD, AT_SLOT), silent_until_s=100.5)
    assert setpoint(silent, inputs()) is None


@pytest.mark.parametrize("state", ["takeoff", "hold", "mission", "return"])
@pytest.mark.parametrize("position_m", [None, (math.nan, 1.0, 2.0), (1.0, 1.0, math.inf)])
def test_without_a_position_the_vehicle_is_told_to_stop(
    state: str, position_m: Vector | None
) -> None:
    given = inputs(position_m, policy_m_s=np.ones(2))
    sent = setpoint(flight(FlightState(state), AT_SLOT), given)
    assert sent == MissionVelocity((0.0, 0.0, 0.0))


def test_arming_streams_a_standstill() -> None:
    sent = setpoint(flight(FlightState.ARMING), inputs((16.0, 16.0, 0.0)))
    assert sent == MissionVelocity((0.0, 0.0, 0.0))


def test_takeoff_climbs_straight_up_at_the_climb_rate_to_the_slot() -> None:
    state = flight(FlightState.TAKEOFF, AT_SLOT)
    vehicle = Vehicle((16.0, 16.0, 0.0))
    vehicle.fly(state, 12.0)
    path_m = np.array(vehicle.path_m)
    assert path_m[:, :2] == pytest.approx(np.full((120, 2), 16.0))
    assert np.diff(path_m[:, 2]).max() <= ROBOT.limits.max_climb_m_s * TICK_S
    assert path_m[-1, 2] == pytest.approx(SLOT_M, abs=0.1)


def test_hold_comes_back_slowly_when_the_estimate_jumps() -> None:
    state = flight(FlightState.HOLD, AT_SLOT)
    here_m = np.array([23.0, 16.0, SLOT_M + 4.0])
    sent_m = position(state, inputs((23.0, 16.0, SLOT_M + 4.0)))
    assert sent_m - here_m == pytest.approx([-1.0, 0.0, -1.0])
    vehicle = Vehicle((23.0, 16.0, SLOT_M))
    vehicle.fly(state, 30.0)
    assert np.abs(np.diff(vehicle.path_m, axis=0)).max() < 1.1 * TICK_S
    assert vehicle.position_m == pytest.approx(AT_SLOT, abs=0.1)


def hold_over_each_other(
    starts_m: F64,
    seconds: float,
    *,
    ground_age_s: Callable[[float], float] = lambda _: 5.0,
    hear_until_s: float = math.inf,
    seed: int = 0,
) -> list[Vehicle]:
    """A fleet that holds at `starts_m` (n, 3), by estimates that err by 5 cm, told 0.4 s late."""
    rng, late = np.random.default_rng(seed), round(0.4 / TICK_S)
    fleet = [Vehicle(_vector(start_m)) for start_m in starts_m]
    memories, told_before = [Guidance()] * len(fleet), []
    for tick in range(round(seconds / TICK_S)):
        errors_m = np.pad(rng.normal(0.0, 0.05, (len(fleet), 2)), ((0, 0), (0, 1)))
        told_before.append(
            [
                Neighbour(i, _vector(v.position_m + errors_m[i]), _vector(v.velocity_m_s), 0.4)
                for i, v in enumerate(fleet)
            ]
        )
        told = told_before[max(tick - late, 0)] if tick * TICK_S < hear_until_s else []
        for i, vehicle in enumerate(fleet):
            place_m, velocity_m_s = vehicle.position_m + errors_m[i], vehicle.velocity_m_s
            given = structs.replace(
                inputs(_vector(place_m), _vector(velocity_m_s)),
                neighbours=tuple(each for each in told if each.robot_id != i),
                ground_age_s=ground_age_s(tick * TICK_S),
            )
            hold = flight(FlightState.HOLD, _vector(starts_m[i]))
            sent, memories[i] = guide(ROBOT, hold, given, memories[i], TICK_S)
            assert isinstance(sent, MissionPosition)
            vehicle.follow(sent)
    return fleet


def least_apart_m(fleet: list[Vehicle]) -> float:
    places_m = [vehicle.position_m[:2] for vehicle in fleet]
    return min(math.dist(one, other) for one, other in itertools.combinations(places_m, 2))


@settings(deadline=None, max_examples=15)
@given(st.integers(2, 10), st.integers(0, 2**32 - 1))
def test_robots_that_lost_their_ground_part_before_they_come_down(robots: int, seed: int) -> None:
    """However they hover over each other, at their own heights, in the middle of the field."""
    rng = np.random.default_rng(seed)
    heights_m = 5.0 + 4.5 * np.arange(robots)
    starts_m = np.column_stack([rng.uniform(12.0, 20.0, (robots, 2)), heights_m])
    fleet = hold_over_each_other(starts_m, 10.0, seed=seed)
    assert least_apart_m(fleet) > (6.8 if robots <= 6 else 5.5)
    for vehicle, height_m in zip(fleet, heights_m, strict=True):
        assert vehicle.position_m[2] == pytest.approx(height_m, abs=0.1)
        speeds_m_s = np.hypot(*np.diff(vehicle.path_m, axis=0)[:, :2].T) / TICK_S
        assert speeds_m_s.max() <= 1.1 * ROBOT.limits.max_speed_m_s


def test_who_is_between_two_others_parts_from_both() -> None:
    line_m = np.array([(8.0, 16.0, 5.0), (15.5, 16.0, 9.5), (16.5, 16.0, 14.0), (24.5, 16.0, 18.5)])
    assert least_apart_m(hold_over_each_other(line_m, 12.0)) > 7.0


@pytest.mark.parametrize("ground_age_s", [0.1, 5.0])
@pytest.mark.parametrize("is_piloted", [True, False])
def test_who_was_carried_far_from_its_place_flies_through_nobody_on_its_way_back(
    is_piloted: bool, ground_age_s: float
) -> None:
    vehicle, hold = Vehicle((27.0, 16.0, SLOT_M)), flight(FlightState.HOLD, AT_SLOT)
    other = Neighbour(2, (25.0, 16.0, SLOT_M), STILL, 0.0, is_piloted=is_piloted)
    vehicle.fly(hold, 20.0, neighbours=(other,), ground_age_s=ground_age_s)
    apart_m = np.linalg.norm(np.array(vehicle.path_m) - other.position_m, axis=1)
    least_m = 1.9 if is_piloted else ROBOT.separation.level_m - 0.1
    assert apart_m.min() > least_m


@pytest.mark.parametrize("climb_m_s", [0.0, -1.5])
def test_who_parts_leaves_a_pilot_and_who_comes_down_as_much_room_as_before(
    climb_m_s: float,
) -> None:
    """Not less, to be further from one that is nearer."""
    vehicle, hold = Vehicle(AT_SLOT), flight(FlightState.HOLD, AT_SLOT)
    above, height_m, least_m = Vehicle((15.5, 16.0, SLOT_M + 4.5)), SLOT_M, math.inf
    start_m = SLOT_M if climb_m_s == 0.0 else SLOT_M + 4.5
    for tick in range(60):
        height_m = start_m + climb_m_s * tick * TICK_S
        third = Neighbour(
            2, (23.25, 16.0, height_m), (0.0, 0.0, climb_m_s), 0.0, is_piloted=climb_m_s == 0.0
        )
        near = Neighbour(3, _vector(above.position_m), _vector(above.velocity_m_s), 0.0)
        own = Neighbour(1, _vector(vehicle.position_m), _vector(vehicle.velocity_m_s), 0.0)
        above_hold = flight(FlightState.HOLD, (15.5, 16.0, SLOT_M + 4.5))
        above.fly(above_hold, TICK_S, neighbours=(own,), ground_age_s=5.0)
        vehicle.fly(hold, TICK_S, neighbours=(third, near), ground_age_s=5.0)
        if abs(height_m - vehicle.position_m[2]) < ROBOT.separation.passing_height_m:
            least_m = min(least_m, math.dist(vehicle.position_m[:2], third.position_m[:2]))
    kept_m = ROBOT.separation.piloted_m if climb_m_s == 0.0 else ROBOT.separation.passing_m
    assert least_m > kept_m - 0.5


PAIR_M = np.array([(16.0, 16.0, 5.0), (16.5, 16.2, 9.5)])


def test_who_has_parted_stays_there_though_it_hears_nobody_or_the_ground_again() -> None:
    deaf = hold_over_each_other(PAIR_M, 20.0, hear_until_s=6.0)
    heard_again = hold_over_each_other(PAIR_M, 20.0, ground_age_s=lambda t: 5.0 if t < 8.0 else 0.1)
    flickers = hold_over_each_other(PAIR_M, 20.0, ground_age_s=lambda t: 2.5 + 0.2 * (t % 5.0))
    assert min(map(least_apart_m, (deaf, heard_again, flickers))) > 6.5


def test_who_does_not_hold_its_height_parts_from_who_is_above_or_below() -> None:
    lost = structs.replace(flight(FlightState.HOLD, AT_SLOT), lift=Lift(off_since_s=97.0))
    for hold, parts in ((lost, True), (flight(FlightState.HOLD, AT_SLOT), False)):
        vehicle = Vehicle(AT_SLOT)
        other = Neighbour(2, (AT_SLOT[0] + 1.0, AT_SLOT[1], SLOT_M - 4.5), STILL, 0.0)
        vehicle.fly(hold, 3.0, neighbours=(other,))
        assert (math.dist(vehicle.position_m[:2], other.position_m[:2]) > 2.5) == parts


def test_who_was_carried_outside_comes_back_before_it_parts() -> None:
    vehicle, hold = Vehicle((-1.0, 16.0, SLOT_M)), flight(FlightState.HOLD, (1.0, 16.0, SLOT_M))
    other = Neighbour(2, (3.0, 16.5, SLOT_M + 4.5), STILL, 0.0)
    vehicle.fly(hold, 20.0, neighbours=(other,), ground_age_s=5.0)
    assert ROBOT.fence.distance_m(*vehicle.position_m[:2].tolist()) > 0.3
    assert math.dist(vehicle.position_m[:2], other.position_m[:2]) > 6.0


@pytest.mark.parametrize("is_piloted", [True, False])
def test_nobody_pushes_who_holds_further_than_that(is_piloted: bool) -> None:
    """A liar that says that it is beside the robot, wherever that goes."""
    vehicle, hold, memory = Vehicle(AT_SLOT), flight(FlightState.HOLD, AT_SLOT), Guidance()
    for _ in range(600):
        beside_m = _vector(vehicle.position_m - (0.5, 0.0, 0.0))
        liar = Neighbour(2, beside_m, STILL, 0.0, is_piloted=is_piloted)
        given = inputs(_vector(vehicle.position_m), _vector(vehicle.velocity_m_s))
        sent, memory = guide(
            ROBOT, hold, structs.replace(given, neighbours=(liar,)), memory, TICK_S
        )
        assert sent is not None
        vehicle.follow(sent)
    assert math.dist(vehicle.position_m, AT_SLOT) < ROBOT.separation.landed_m + 0.1


def test_who_lost_the_ground_leaves_who_stands_below_it_and_keeps_inside_the_fence() -> None:
    vehicle = Vehicle((3.0, 16.0, SLOT_M))
    below = Neighbour(2, (4.0, 16.0, 0.0), STILL, 0.2)
    hold = flight(FlightState.HOLD, (3.0, 16.5, SLOT_M))
    vehicle.fly(hold, 20.0, neighbours=(below,), ground_age_s=5.0)
    assert math.dist(vehicle.position_m[:2], (4.0, 16.0)) > 7.5
    assert ROBOT.fence.distance_m(*vehicle.position_m[:2].tolist()) > 1.5


def test_nobody_leaves_its_place_while_the_ground_is_heard_or_by_what_is_no_measurement() -> None:
    above = Neighbour(2, (16.0, 17.0, SLOT_M + 4.5), STILL, 0.2)
    broken = Neighbour(4, (math.nan, 17.0, SLOT_M), STILL, 0.2)
    hold = flight(FlightState.HOLD, AT_SLOT)
    held = position(hold, inputs(neighbours=(above,)))
    lost = structs.replace(inputs(neighbours=(broken,)), ground_age_s=5.0)
    np.testing.assert_allclose([held, position(hold, lost)], [AT_SLOT] * 2)


def test_who_holds_makes_way_for_one_that_comes_down_through_its_height_and_comes_back() -> None:
    vehicle, hold = Vehicle(AT_SLOT), flight(FlightState.HOLD, AT_SLOT)
    height_m, apart_m = SLOT_M + 9.0, []
    while height_m > 0.0:
        other = Neighbour(2, (16.5, 16.0, height_m), (0.0, 0.0, -1.5), 0.0)
        vehicle.fly(hold, TICK_S, neighbours=(other,))
        height_m -= 1.5 * TICK_S
        apart_m.append(math.dist(vehicle.position_m, (16.5, 16.0, height_m)))
    assert min(apart_m) > 4.0
    vehicle.fly(hold, 20.0)
    assert vehicle.position_m == pytest.approx(AT_SLOT, abs=0.2)


def _vector(values: F64) -> Vector:
    x, y, z = values.tolist()
    return x, y, z


def test_return_flies_level_only_at_its_own_height() -> None:
    vehicle = Vehicle((28.0, 28.0, 1.5))
    vehicle.fly(flight(FlightState.RETURN), 60.0)
    path_m = np.array(vehicle.path_m)
    away = np.hypot(*(path_m[:, :2] - 28.0).T) > 0.1
    assert (path_m[away, 2] > SLOT_M - 1.05).all()
    assert vehicle.position_m == pytest.approx([10.0, 12.0, SLOT_M], abs=0.2)
    speeds = np.hypot(*(np.diff(path_m[:, :2], axis=0) / TICK_S).T)
    assert speeds.max() <= ROBOT.limits.max_speed_m_s
    # It arrives, it does not swing.
    distances_m = np.hypot(*(path_m[:, :2] - (10.0, 12.0)).T)
    assert np.diff(distances_m).max() < 0.01


def test_mission_flies_the_policy_at_the_slot_height_and_speeds_up_smoothly() -> None:
    state, wanted = flight(FlightState.MISSION), np.array([1.2, -0.9])
    memory, speeds = Guidance(), []
    for _ in range(20):
        low = inputs((16.0, 16.0, SLOT_M - 0.4), policy_m_s=wanted)
        sent, memory = guide(ROBOT, state, low, memory, TICK_S)
        assert isinstance(sent, MissionVelocity)
        assert sent.velocity_m_s[2] == pytest.approx(0.4)
        speeds.append(math.hypot(*sent.velocity_m_s[:2]))
    assert np.diff([0.0, *speeds]).max() <= ROBOT.limits.max_acceleration_m_s2 * TICK_S + 1e-9
    assert speeds[-1] == pytest.approx(1.5)


@pytest.mark.parametrize("state", [FlightState.MISSION, FlightState.RETURN])
def test_the_fence_is_not_crossed_and_one_who_is_outside_comes_back(state: FlightState) -> None:
    vehicle = Vehicle(AT_SLOT)
    vehicle.fly(flight(FlightState.MISSION), 30.0, np.array([2.0, 0.3]))
    assert max(place[0] for place in vehicle.path_m) <= 30.2
    outside = Vehicle((36.0, 16.0, SLOT_M))
    outside.fly(flight(state), 20.0, np.array([2.0, 0.0]))
    assert ROBOT.fence.distance_m(*outside.position_m[:2]) > 0.0


@pytest.mark.parametrize("state", [FlightState.MISSION, FlightState.RETURN])
def test_a_neighbour_in_the_way_stops_and_one_in_another_slot_does_not(state: FlightState) -> None:
    for above_m, passes in ((0.0, False), (2.0, True)):
        there: Vector = (13.0, 14.0, SLOT_M + above_m)
        vehicle = Vehicle(AT_SLOT)
        neighbour = Neighbour(4, there, STILL, 0.1)
        vehicle.fly(flight(state), 30.0, np.array([-0.75, -0.5]), (neighbour,))
        nearest_m = min(math.dist(place, there) for place in vehicle.path_m)
        level_m = min(math.dist(place[:2], there[:2]) for place in vehicle.path_m)
        assert nearest_m >= ROBOT.parameters.min_separation_m
        assert (level_m < 1.0) is passes


coordinates = st.floats(-60.0, 60.0)
speeds = st.floats(-8.0, 8.0)
vectors = st.tuples(coordinates, coordinates, coordinates)


@settings(max_examples=300, deadline=None)
@given(
    state=st.sampled_from(["takeoff", "hold", "mission", "return"]),
    here_m=vectors,
    velocity_m_s=st.tuples(speeds, speeds, speeds),
    target_m=st.none() | vectors,
    direction_rad=st.none() | st.floats(-4.0, 4.0) | st.just(math.nan),
    others=st.lists(st.tuples(vectors, st.tuples(speeds, speeds, speeds)), max_size=3),
    recovering=st.booleans(),
    dt_s=st.sampled_from([0.0, 0.1, 5.0]),
)
def test_what_is_sent_is_finite_near_and_within_the_limits(
    state: str,
    here_m: Vector,
    velocity_m_s: Vector,
    target_m: Vector | None,
    direction_rad: float | None,
    others: list[tuple[Vector, Vector]],
    recovering: bool,
    dt_s: float,
) -> None:
    policy_m_s = None
    if direction_rad is not None:
        policy_m_s = 2.0 * np.array([math.cos(direction_rad), math.sin(direction_rad)])
    neighbours = tuple(Neighbour(9, *other, 0.3) for other in others)
    sent, memory = guide(
        ROBOT,
        flight(FlightState(state), target_m),
        inputs(here_m, velocity_m_s, policy_m_s, neighbours),
        Guidance(np.array([1.0, 1.0, 0.0]), recovering),
        dt_s,
    )
    assert sent is not None
    assert np.isfinite(memory.velocity_m_s).all()
    step_m = np.array(sent[0])
    if isinstance(sent, MissionPosition):
        step_m = step_m - here_m  # About what is flown in a second.
    assert np.isfinite(step_m).all()
    assert math.hypot(*step_m[:2]) <= ROBOT.limits.max_speed_m_s + 1e-9
    assert abs(step_m[2]) <= ROBOT.limits.max_climb_m_s + 1e-9


def test_takeoff_stops_below_a_robot_that_hovers_above_and_goes_on_when_it_is_gone() -> None:
    state = flight(FlightState.TAKEOFF, AT_SLOT)
    x_m, y_m, _ = AT_SLOT
    separation_m = ROBOT.parameters.min_separation_m
    above = Neighbour(7, (x_m + 0.5, y_m, 4.0), STILL, 0.1)
    vehicle = Vehicle((x_m, y_m, 0.0))
    vehicle.fly(state, 20.0, neighbours=(above,))
    assert max(place_m[2] for place_m in vehicle.path_m) <= 4.0 - separation_m + 0.05
    vehicle.fly(state, 20.0)
    assert vehicle.position_m[2] == pytest.approx(SLOT_M, abs=0.1)
    # One that hovers beside the way, or below, stops nobody.
    for place_m in ((x_m + 2.0 * separation_m, y_m, 4.0), (x_m, y_m, 0.5)):
        elsewhere = Neighbour(7, place_m, STILL, 0.1)
        sent_m = position(state, inputs((x_m, y_m, 3.0), neighbours=(elsewhere,)))
        assert sent_m[2] > 3.9
