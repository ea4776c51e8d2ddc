"""Safety: what is commanded keeps a lagging vehicle inside its fence and apart from others."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from edge.core import F64
from edge.core.fence import Fence
from edge.core.schema import ConfigError, from_mapping
from edge.flight.safety import (
    Closest,
    MotionLimits,
    SeparationLimits,
    approach_speed,
    brake,
    clear_height_m,
    hold_height,
    keep_inside,
    leash,
    limit_acceleration,
    limit_speed,
    nearest,
)
from edge.flight.silence import SilenceLimits
from edge.messages.beacon import Neighbour

SQUARE = ((0.0, 0.0), (32.0, 0.0), (32.0, 32.0), (0.0, 32.0))
FENCE = Fence(SQUARE, buffer_m=2.0, floor_m=3.0, ceiling_m=25.0)
LIMITS = MotionLimits(max_speed_m_s=3.0, max_climb_m_s=1.0, max_acceleration_m_s2=2.0, lag_s=1.3)
FIELD_LIMITS = MotionLimits(1.25, max_climb_m_s=1.0, max_acceleration_m_s2=2.0, lag_s=1.3)
SILENCE = SilenceLimits(max_speed_m_s=1.25, ceiling_m=34.5, flies_on_s=3.0, hovers_s=60.0)
FIELD_SEPARATION = SeparationLimits(
    level_m=1.5, passing_m=6.5, passing_height_m=3.5, piloted_m=7.25, landed_m=8.0, silence=SILENCE
)
CONTROL_S, STEP_S = 0.1, 0.02
AT_REST = np.zeros(3)
LEVEL_2, LEVEL_3 = FIELD_SEPARATION._replace(level_m=2.0), FIELD_SEPARATION._replace(level_m=3.0)


def number(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_subnormal=False)


def vectors(size: float) -> st.SearchStrategy[F64]:
    return st.tuples(*[number(-size, size)] * 3).map(np.array)


numbers_with_rubbish = st.floats(allow_nan=True, allow_infinity=True)
rubbish = st.tuples(*[numbers_with_rubbish] * 3).map(np.array)
motion_limits = st.builds(
    MotionLimits,
    max_speed_m_s=number(0.5, 5.0),
    max_climb_m_s=number(0.3, 3.0),
    max_acceleration_m_s2=number(1.0, 6.0),
    lag_s=number(0.0, 1.3),
)


@st.composite
def fences(draw: st.DrawFn) -> Fence:
    """A polygon with its corners on an ellipse, either way round, often with acute corners."""
    gaps = draw(st.lists(number(0.15, 1.0), min_size=3, max_size=7))
    angles = np.cumsum(gaps) / sum(gaps) * math.tau
    radii = draw(number(15.0, 60.0)), draw(number(15.0, 60.0))
    corners = [(radii[0] * math.cos(a), radii[1] * math.sin(a)) for a in angles.tolist()]
    if draw(st.booleans()):
        corners.reverse()
    buffer_m = draw(number(0.5, 3.0))
    try:
        return Fence(tuple(corners), buffer_m, floor_m=3.0, ceiling_m=draw(number(6.0, 30.0)))
    except ValueError:  # A sliver with less room than the buffer.
        return Fence(SQUARE, buffer_m, floor_m=3.0, ceiling_m=20.0)


def start(data: st.DataObject, fence: Fence) -> F64:
    """Somewhere inside by the buffer."""
    centre = np.mean(fence.vertices_m, axis=0)
    corner = np.array(data.draw(st.sampled_from(fence.vertices_m)))
    share = 1.0
    while fence.distance_m(*(centre + share * (corner - centre))) < fence.buffer_m and share > 0.0:
        share -= 0.02
    x, y = centre + share * data.draw(number(0.0, 1.0)) * (corner - centre)
    return np.array([x, y, data.draw(number(fence.floor_m, fence.ceiling_m))])


class Vehicle:
    """Follows a velocity with a lag and within an acceleration; wind may push it."""

    def __init__(self, position_m: F64, lag_s: float, max_acceleration_m_s2: float) -> None:
        self.position_m = position_m
        self.velocity_m_s = np.zeros(3)
        self.lag_s = max(lag_s, STEP_S)
        # It can brake in one direction and turn in another.
        self.max_acceleration_m_s2 = math.sqrt(2.0) * max_acceleration_m_s2

    def fly(self, command_m_s: F64, push_m_s2: F64) -> list[F64]:
        """One control period; where it was."""
        path = []
        for _ in range(round(CONTROL_S / STEP_S)):
            acceleration = (command_m_s - self.velocity_m_s) / self.lag_s
            size = math.hypot(*acceleration)
            acceleration = acceleration * min(1.0, self.max_acceleration_m_s2 / max(size, 1e-9))
            self.velocity_m_s = self.velocity_m_s + (acceleration + push_m_s2) * STEP_S
            self.position_m = self.position_m + self.velocity_m_s * STEP_S
            path.append(self.position_m)
        return path


def policy(data: st.DataObject, limits: MotionLimits) -> Callable[[int], F64]:
    """Random headings at full speed and full climb, each kept for a while."""
    wanted = [
        np.array(
            [
                limits.max_speed_m_s * math.cos(angle),
                limits.max_speed_m_s * math.sin(angle),
                limits.max_climb_m_s * climb,
            ]
        )
        for angle, climb in data.draw(
            st.lists(st.tuples(number(0.0, math.tau), number(-1.0, 1.0)), min_size=1, max_size=5)
        )
    ]
    period = data.draw(st.integers(3, 150))
    return lambda tick: wanted[tick // period % len(wanted)]


@settings(deadline=None, max_examples=60)
@given(st.data())
def test_without_wind_the_line_is_never_crossed_at_any_lag_up_to_the_measured_one(
    data: st.DataObject,
) -> None:
    fence, limits = data.draw(fences()), data.draw(motion_limits)
    wants = policy(data, limits)
    lag_s = data.draw(number(0.0, limits.lag_s))
    vehicle = Vehicle(start(data, fence), lag_s, limits.max_acceleration_m_s2)
    is_late = data.draw(st.booleans())
    seen = vehicle.position_m, vehicle.velocity_m_s
    previous, recovering = AT_REST, False
    for tick in range(250):
        now = vehicle.position_m, vehicle.velocity_m_s
        position_m, velocity_m_s = seen if is_late else now
        seen = now
        previous = limit_acceleration(
            previous, wants(tick), limits.max_acceleration_m_s2, CONTROL_S
        )
        command, recovering = keep_inside(
            fence, position_m, velocity_m_s, previous, limits, recovering
        )
        for at in vehicle.fly(command, AT_REST):
            assert fence.distance_m(at[0], at[1]) > 0.5 * fence.buffer_m
            assert fence.floor_m - 0.3 <= at[2] <= fence.ceiling_m + 0.3
        assert not recovering


@settings(deadline=None, max_examples=40)
@given(st.data())
def test_a_vehicle_that_a_gust_carried_outside_returns_against_the_wind(
    data: st.DataObject,
) -> None:
    fence, limits = data.draw(fences()), data.draw(motion_limits)
    bearing = data.draw(number(0.0, math.tau))
    outwards = np.array([math.cos(bearing), math.sin(bearing), 0.0])
    position_m = start(data, fence)
    while fence.distance_m(position_m[0], position_m[1]) > -3.0:
        position_m = position_m + outwards
    vehicle = Vehicle(position_m, limits.lag_s, limits.max_acceleration_m_s2)
    vehicle.velocity_m_s = data.draw(number(0.0, 4.0)) * outwards
    # What the vehicle leaves of the wind: it drifts at a third of the speed that it returns with.
    drift_m_s = limits.max_speed_m_s / 6.0
    wind = min(drift_m_s / vehicle.lag_s, limits.max_acceleration_m_s2 / 3.0) * outwards
    recovering = True
    ticks = 0
    while recovering:
        command, recovering = keep_inside(
            fence,
            vehicle.position_m,
            vehicle.velocity_m_s,
            limits.max_speed_m_s * outwards,
            limits,
            recovering,
        )
        assert math.hypot(*command[:2]) <= limits.max_speed_m_s
        vehicle.fly(command, wind)
        ticks += 1
        assert ticks < 3000
    assert fence.distance_m(*vehicle.position_m[:2]) > 0.4 * fence.buffer_m


def test_a_vehicle_outside_is_brought_back_until_half_the_buffer_inside() -> None:
    command, recovering = keep_inside(
        FENCE, np.array([-1.0, 16.0, 10.0]), AT_REST, np.array([-3.0, 2.0, 0.0]), LIMITS, False
    )
    assert recovering
    np.testing.assert_allclose(command, [1.5, 0.0, 0.0])
    inside_a_bit = np.array([0.9, 16.0, 10.0])
    assert keep_inside(FENCE, inside_a_bit, AT_REST, AT_REST, LIMITS, True)[1]
    assert not keep_inside(FENCE, inside_a_bit, AT_REST, AT_REST, LIMITS, False)[1]
    inside_enough = np.array([1.1, 16.0, 10.0])
    assert not keep_inside(FENCE, inside_enough, AT_REST, AT_REST, LIMITS, True)[1]


def test_only_the_way_outwards_is_slowed() -> None:
    wanted = np.array([-1.0, 1.0, 0.0])
    at_the_buffer = np.array([2.0, 16.0, 10.0])
    command, _ = keep_inside(FENCE, at_the_buffer, AT_REST, wanted, LIMITS, False)
    np.testing.assert_allclose(command, [0.0, 1.0, 0.0], atol=1e-9)
    in_the_middle = np.array([16.0, 16.0, 10.0])
    command, _ = keep_inside(FENCE, in_the_middle, AT_REST, wanted, LIMITS, False)
    np.testing.assert_array_equal(command, wanted)


def test_a_vehicle_that_drifts_outwards_is_slowed_more_than_one_at_rest() -> None:
    position_m, wanted = np.array([5.0, 16.0, 10.0]), np.array([-3.0, 0.0, 0.0])
    at_rest, _ = keep_inside(FENCE, position_m, AT_REST, wanted, LIMITS, False)
    drifting, _ = keep_inside(FENCE, position_m, np.array([-2.0, 0.0, 0.0]), wanted, LIMITS, False)
    assert at_rest[0] < drifting[0] <= 0.0


@pytest.mark.parametrize(
    ("height_m", "wanted_m_s", "climb_m_s"),
    [(25.0, 1.0, 0.0), (25.5, 1.0, -0.5), (30.0, 0.0, -1.0), (3.0, -1.0, 0.0), (2.0, -1.0, 1.0)],
)
def test_heights_stop_at_floor_and_ceiling_and_come_back_to_them(
    height_m: float, wanted_m_s: float, climb_m_s: float
) -> None:
    command, recovering = keep_inside(
        FENCE,
        np.array([16.0, 16.0, height_m]),
        AT_REST,
        np.array([0.0, 0.0, wanted_m_s]),
        LIMITS,
        False,
    )
    assert command[2] == pytest.approx(climb_m_s, abs=1e-9)
    assert not recovering


@given(fences(), st.tuples(number(-80, 80), number(-80, 80)), number(-20, 20), number(-20, 20))
def test_fence_distance_is_the_depth_inside_and_continuous(
    fence: Fence, point: tuple[float, float], step_x: float, step_y: float
) -> None:
    distance_m = fence.distance_m(*point)
    moved_m = fence.distance_m(point[0] + step_x, point[1] + step_y)
    assert abs(moved_m - distance_m) <= math.hypot(step_x, step_y) + 1e-9
    for vertex in fence.vertices_m:
        assert fence.distance_m(*vertex) == pytest.approx(0.0, abs=1e-6)


def test_fence_distance_of_a_square() -> None:
    for fence in (FENCE, Fence(SQUARE[::-1], 2.0, 3.0, 25.0)):
        assert fence.distance_m(5.0, 10.0) == pytest.approx(5.0)
        assert fence.distance_m(-3.0, 10.0) == pytest.approx(-3.0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"vertices_m": [[0, 0], [1, 0]]},
            r"vertices_m = \[\[0, 0\], \[1, 0\]\]: must be 3 to 100 long",
        ),
        ({"vertices_m": [[0, 0], [9, 0], [9]]}, r"vertices_m\[2\] = \[9\]: must be \[x, y\]"),
        (
            {"vertices_m": [[0, 0], [9, 0], [9, math.nan]]},
            r"vertices_m\[2\]\[1\] = nan: must be from -10000 to 10000",
        ),
        ({"vertices_m": [[0, 0], [9, 9], [18, 18]]}, "convex"),
        ({"vertices_m": [[0, 0], [9, 0], [9, 0], [0, 9]]}, "none twice"),
        ({"vertices_m": [[0, 0], [20, 0], [20, 20], [15, 5]]}, "convex"),
        ({"vertices_m": [[0, 0], [20, 20], [20, 0], [0, 20]]}, "convex"),
        # A pentagram turns one way all round, but twice.
        (
            {
                "vertices_m": [
                    [50 * math.cos(k * 0.8 * math.pi), 50 * math.sin(k * 0.8 * math.pi)]
                    for k in range(5)
                ]
            },
            "convex",
        ),
        ({"buffer_m": 16.0}, "buffer_m = 16.0: must be below 16"),
        ({"buffer_m": 0.0}, "buffer_m = 0.0: must be above 0 and finite"),
        ({"floor_m": -1.0}, "floor_m = -1.0: must be at least 0 and finite"),
        ({"ceiling_m": 3.0}, "ceiling_m = 3.0: must be above floor_m"),
    ],
)
def test_a_fence_that_makes_no_sense_is_refused_by_name(
    change: dict[str, object], said: str
) -> None:
    good = {
        "vertices_m": [list(vertex) for vertex in SQUARE],
        "buffer_m": 2.0,
        "floor_m": 3.0,
        "ceiling_m": 25.0,
    }
    assert from_mapping(Fence, good, "robot.toml: fence") == FENCE
    with pytest.raises(ConfigError, match=said):
        from_mapping(Fence, good | change, "robot.toml: fence")


@pytest.mark.parametrize("name", ["max_speed_m_s", "max_climb_m_s", "max_acceleration_m_s2"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.inf, math.nan])
def test_motion_limits_that_make_no_sense_are_refused_by_name(name: str, value: float) -> None:
    good = {"max_speed_m_s": 3.0, "max_climb_m_s": 1.0, "max_acceleration_m_s2": 2.0, "lag_s": 1.3}
    with pytest.raises(ConfigError, match=f"{name} = {value}"):
        from_mapping(MotionLimits, good | {name: value}, "robot.toml: limits")
    with pytest.raises(ConfigError, match=r"lag_s = -0\.1"):
        from_mapping(MotionLimits, good | {"lag_s": -0.1}, "robot.toml: limits")


@given(number(-1e4, 1e4), motion_limits)
def test_approach_speed_is_the_largest_that_the_distance_is_enough_for(
    distance_m: float, limits: MotionLimits
) -> None:
    speed = approach_speed(distance_m, limits)
    needed_m = speed * limits.lag_s + speed * speed / (2.0 * limits.max_acceleration_m_s2)
    assert needed_m == pytest.approx(max(distance_m, 0.0), abs=1e-9)


def neighbour(robot_id: int, *position_m: float, **at: object) -> Neighbour:
    return Neighbour(robot_id, position_m, **({"velocity_m_s": AT_REST, "age_s": 0.0} | at))  # type: ignore[arg-type]


def test_the_way_towards_a_neighbour_is_slowed_and_no_other() -> None:
    wanted = np.array([2.0, 1.0, 0.5])
    command = brake(
        AT_REST, AT_REST, wanted, [neighbour(7, 3.0, 0.0, 0.0)], (), LEVEL_3, LIMITS, None
    )
    np.testing.assert_allclose(command, [0.0, 1.0, 0.5], atol=1e-9)
    away = brake(
        AT_REST, AT_REST, -wanted, [neighbour(7, 1.0, 0.0, 0.0)], (), LEVEL_3, LIMITS, None
    )
    np.testing.assert_array_equal(away, -wanted)


def test_robots_cross_in_their_height_slots() -> None:
    wanted = np.array([2.0, 0.0, 0.0])
    above = neighbour(2, 0.5, 0.0, 2.0)
    command = brake(AT_REST, AT_REST, wanted, [above], (), LEVEL_2, LIMITS, None)
    np.testing.assert_array_equal(command, wanted)
    # Nearer in height, it needs as much horizontally as is missing: 1.32 m of a sphere.
    command = brake(
        AT_REST, AT_REST, wanted, [neighbour(2, 1.33, 0.0, 1.5)], (), LEVEL_2, LIMITS, None
    )
    assert 0.0 <= command[0] < 0.01
    command = brake(
        AT_REST, AT_REST, wanted, [neighbour(2, 1.3, 0.0, 1.5)], (), LEVEL_2, LIMITS, None
    )
    assert -0.02 < command[0] < 0.0


@settings(deadline=None, max_examples=5)
@given(st.floats(0.1, 1.4), st.floats(0.0, math.tau), st.integers(0, 2**32 - 1))
def test_who_waits_for_a_neighbour_does_not_creep_up_to_it_as_estimates_wander(
    apart_m: float, bearing_rad: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    separation, wander_m, tick_s = FIELD_SEPARATION, 0.2, 0.1
    position_m = apart_m * np.array([math.cos(bearing_rad), math.sin(bearing_rad), 0.0])
    velocity_m_s, errors_m = np.zeros(3), np.zeros((2, 3))
    distances_m = []
    for _ in range(1200):
        # Its own, and the neighbour's, with a time constant of 5 s.
        errors_m += -errors_m * tick_s / 5.0
        errors_m[:, :2] += wander_m * math.sqrt(2.0 * tick_s / 5.0) * rng.normal(size=(2, 2))
        seen_m = position_m + errors_m[0]
        other = neighbour(2, *errors_m[1].tolist())
        command = brake(seen_m, velocity_m_s, -seen_m, [other], (), separation, LIMITS, None)
        velocity_m_s = velocity_m_s + (command - velocity_m_s) * tick_s / 0.5
        position_m = position_m + velocity_m_s * tick_s
        distances_m.append(math.hypot(*position_m[:2]))
    # Once they have parted, only the errors of the moment count: it stays, and stays near.
    assert min(distances_m[300:]) > separation.level_m - 5.0 * wander_m
    assert np.mean(distances_m[300:]) == pytest.approx(separation.level_m, abs=2.0 * wander_m)


@pytest.mark.parametrize("speed_m_s", [-1.25, 0.0, 1.25])
@pytest.mark.parametrize("start_m", [0.3, 0.5, 0.75, 1.0, 2.0, 3.0])
@pytest.mark.parametrize(("above_m", "least_m"), [(4.5, 1.5), (9.0, 4.0)])
def test_the_way_under_who_comes_down_is_left_in_time(
    speed_m_s: float, start_m: float, above_m: float, least_m: float
) -> None:
    """At the field's speeds, by a vehicle that follows late, and may be on its way under it."""
    vehicle = Vehicle(
        np.array([start_m, 0.05, 5.0]), FIELD_LIMITS.lag_s, FIELD_LIMITS.max_acceleration_m_s2
    )
    vehicle.velocity_m_s = np.array([speed_m_s, 0.0, 0.0])
    height_m, distances_m = 5.0 + above_m, []
    while height_m > 5.0 - FIELD_SEPARATION.passing_height_m:
        above = neighbour(2, 0.0, 0.0, height_m, velocity_m_s=(0.0, 0.0, -1.5))
        # The policy wants to be right there.
        wanted = limit_speed(-vehicle.position_m[:2], FIELD_LIMITS.max_speed_m_s)
        vehicle.fly(passing(vehicle, np.append(wanted, 0.0), above), AT_REST)
        height_m -= 1.5 * CONTROL_S
        distances_m.append(math.dist(vehicle.position_m, (0.0, 0.0, height_m)))
    assert min(distances_m) > least_m


def passing(
    vehicle: Vehicle, wanted_m_s: F64, *others: Neighbour, silent: Sequence[Neighbour] = ()
) -> F64:
    at_m, velocity_m_s, separation = vehicle.position_m, vehicle.velocity_m_s, FIELD_SEPARATION
    return brake(at_m, velocity_m_s, wanted_m_s, others, silent, separation, FIELD_LIMITS, None)


@pytest.mark.parametrize("bearing_rad", [0.05, 0.7, 1.5, 3.0, 4.5])
@pytest.mark.parametrize("start_m", [0.5, 3.0, 10.0])
def test_nobody_flies_below_where_a_silent_robot_may_have_stopped(
    start_m: float, bearing_rad: float
) -> None:
    way_m_s, since_s = np.array([1.25, 0.0]), 1.5
    start = start_m * np.array([math.cos(bearing_rad), math.sin(bearing_rad)])
    vehicle = Vehicle(
        np.array([*start, 5.0]), FIELD_LIMITS.lag_s, FIELD_LIMITS.max_acceleration_m_s2
    )
    distances_m = []
    for tick in range(400):
        age_s = since_s + tick * CONTROL_S
        silent = neighbour(2, 0.0, 0.0, 14.0, velocity_m_s=(*way_m_s, 0.0), age_s=age_s)
        # The policy wants to be right there.
        wanted = limit_speed(way_m_s - vehicle.position_m[:2], FIELD_LIMITS.max_speed_m_s)
        vehicle.fly(passing(vehicle, np.append(wanted, 0.0), silent=[silent]), AT_REST)
        possible_places_m = np.linspace(0.0, min(age_s, SILENCE.flies_on_s), 20)[:, None] * way_m_s
        distances_m.append(np.hypot(*(possible_places_m - vehicle.position_m[:2]).T).min())
    # It left, whichever way it began, and did not come back.
    deviation_m = 0.5 * way_m_s[0] * SILENCE.flies_on_s
    assert min(distances_m[120:]) > FIELD_SEPARATION.landed_m + deviation_m - 0.3


@pytest.mark.parametrize(
    ("up_m", "is_piloted", "kept_m"), [(0.0, True, 7.25), (3.0, True, 7.25), (0.0, False, 1.5)]
)
def test_who_is_piloted_at_ones_height_is_left_more_room(
    up_m: float, is_piloted: bool, kept_m: float
) -> None:
    vehicle = Vehicle(
        np.array([12.0, 0.0, 5.0]), FIELD_LIMITS.lag_s, FIELD_LIMITS.max_acceleration_m_s2
    )
    other = neighbour(2, 0.0, 0.0, 5.0 + up_m, is_piloted=is_piloted)
    distances_m = []
    for _ in range(600):
        wanted = limit_speed(-vehicle.position_m[:2], FIELD_LIMITS.max_speed_m_s)
        vehicle.fly(passing(vehicle, np.append(wanted, 0.0), other), AT_REST)
        distances_m.append(math.hypot(*vehicle.position_m[:2]))
    assert min(distances_m) == pytest.approx(kept_m, abs=0.1)


@pytest.mark.parametrize("climb_m_s", [0.0, 0.3, -0.6, 1.0])
def test_who_is_piloted_is_left_as_much_room_when_it_climbs_or_comes_down(climb_m_s: float) -> None:
    still = Vehicle(AT_REST, FIELD_LIMITS.lag_s, FIELD_LIMITS.max_acceleration_m_s2)
    other = neighbour(2, 7.0, 0.0, 0.0, velocity_m_s=(0.0, 0.0, climb_m_s), is_piloted=True)
    assert -0.5 < passing(still, np.array([0.2, 0.0, 0.0]), other)[0] < 0.0


@pytest.mark.parametrize(
    ("near", "silent"),
    [
        (neighbour(3, -1.0, 0.0, 3.0, velocity_m_s=(0.0, 0.0, -0.7)), ()),
        (None, (neighbour(3, -1.0, 0.0, 3.0, age_s=5.0),)),
    ],
)
def test_who_is_near_is_left_towards_one_that_is_piloted_further_off(
    near: Neighbour | None, silent: tuple[Neighbour, ...]
) -> None:
    still = Vehicle(AT_REST, FIELD_LIMITS.lag_s, FIELD_LIMITS.max_acceleration_m_s2)
    piloted = neighbour(2, 6.0, 0.0, 0.0, is_piloted=True)
    others = [piloted] if near is None else [piloted, near]
    assert passing(still, AT_REST, *others, silent=silent)[0] > 0.05


def test_who_is_piloted_far_above_brakes_nobody() -> None:
    still = Vehicle(AT_REST, FIELD_LIMITS.lag_s, FIELD_LIMITS.max_acceleration_m_s2)
    above = neighbour(2, 1.0, 0.0, 4.5, is_piloted=True)
    assert passing(still, np.array([1.0, 0.0, 0.0]), above)[0] == 1.0


@pytest.mark.parametrize(
    ("up_m", "age_s", "may_come_down"),
    [
        (9.0, 2.0, True),
        (-3.0, 2.0, True),  # In truth it may still be at this height.
        (-4.5, 2.0, False),
        (9.0, 80.0, True),
        (9.0, 90.0, False),  # It came by, after a minute at the latest.
    ],
)
def test_a_silent_robot_is_left_its_way_down_until_it_must_have_passed(
    up_m: float, age_s: float, may_come_down: bool
) -> None:
    still = Vehicle(
        np.array([0.0, 0.0, 5.0]), FIELD_LIMITS.lag_s, FIELD_LIMITS.max_acceleration_m_s2
    )
    wanted = np.array([1.0, 0.0, 0.0])
    silent = [neighbour(2, 4.0, 0.0, 5.0 + up_m, age_s=age_s)]
    assert (passing(still, wanted, silent=silent)[0] < -0.5) == may_come_down
    assert passing(still, wanted, silent=[])[0] == 1.0
    unknown = neighbour(2, 4.0, 0.0, math.nan, age_s=age_s)
    assert not passing(still, wanted, silent=[unknown]).any()


def test_of_two_that_come_down_the_nearer_one_is_left() -> None:
    down = {"velocity_m_s": (0.0, 0.0, -1.5)}
    near, far = neighbour(1, -1.0, 0.0, 3.0, **down), neighbour(2, 6.4, 0.0, 3.0, **down)
    for others in ((near, far), (far, near)):
        still = Vehicle(AT_REST, FIELD_LIMITS.lag_s, FIELD_LIMITS.max_acceleration_m_s2)
        assert passing(still, AT_REST, *others)[0] > 1.0


@pytest.mark.parametrize(
    ("up_m", "climb_m_s", "passes"),
    [
        (9.0, -1.5, True),
        (9.0, -0.2, False),
        (9.0, 1.0, False),
        (40.0, -1.5, False),
        (-4.5, 1.0, True),
        (-4.5, -1.0, False),
        (-3.0, -1.0, True),  # In truth it may still be at this height.
    ],
)
def test_who_climbs_or_comes_down_through_ones_height_is_given_its_way(
    up_m: float, climb_m_s: float, passes: bool
) -> None:
    still = Vehicle(AT_REST, FIELD_LIMITS.lag_s, FIELD_LIMITS.max_acceleration_m_s2)
    other = neighbour(2, 4.0, 0.0, up_m, velocity_m_s=(0.0, 0.0, climb_m_s))
    command = passing(still, np.array([1.0, 0.0, 0.0]), other)
    assert (command[0] < -0.5) == passes
    assert command[0] in {1.0} or passes


def test_the_nearest_neighbour_is_where_it_has_flown_to_since() -> None:
    near = neighbour(1, 5.0, 0.0, 0.0, velocity_m_s=(10.0, 0.0, 0.0), age_s=1.0)
    far = neighbour(2, 0.0, 12.0, 0.0, velocity_m_s=(0.0, -4.0, 0.0), age_s=0.5)
    assert nearest((0.0, 0.0, 0.0), [near, far]) == Closest(2, 10.0)
    assert nearest((0.0, 0.0, 0.0), []) is None


@pytest.mark.slow
@settings(deadline=None, max_examples=40)
@given(st.data())
def test_robots_at_one_height_that_all_fly_to_one_point_keep_apart_and_inside(
    data: st.DataObject,
) -> None:
    limits, level_m = data.draw(motion_limits), data.draw(number(1.0, 4.0))
    separation = FIELD_SEPARATION._replace(level_m=level_m)
    fence = Fence(((-16.0, -12.0), (16.0, -12.0), (0.0, 24.0)), 1.0, 3.0, 25.0)
    corners = ((-11.0, -10.0), (11.0, -10.0), (0.0, 16.0), (0.0, 0.0))
    starts = data.draw(st.permutations(corners))[: data.draw(st.integers(2, 4))]
    goal = np.array(data.draw(st.tuples(number(-20.0, 20.0), number(-20.0, 30.0))))
    vehicles = [
        Vehicle(np.array([*xy, 10.0]), limits.lag_s, limits.max_acceleration_m_s2) for xy in starts
    ]
    told = [AT_REST] * len(vehicles)
    for _ in range(200):
        heard = [
            neighbour(k, *vehicle.position_m, velocity_m_s=vehicle.velocity_m_s)
            for k, vehicle in enumerate(vehicles)
        ]
        for own, vehicle in enumerate(vehicles):
            position_m, velocity_m_s = vehicle.position_m, vehicle.velocity_m_s
            wanted = limit_speed(10.0 * (goal - position_m[:2]), limits.max_speed_m_s)
            told[own] = limit_acceleration(
                told[own], np.append(wanted, 0.0), limits.max_acceleration_m_s2, CONTROL_S
            )
            inside, recovering = keep_inside(
                fence, position_m, velocity_m_s, told[own], limits, False
            )
            others = [other for other in heard if other.robot_id != own]
            closest = nearest(position_m.tolist(), others)
            command = brake(position_m, velocity_m_s, inside, others, (), separation, limits, fence)
            vehicle.fly(command, AT_REST)
            assert not recovering
            assert fence.distance_m(*vehicle.position_m[:2]) > 0.5 * fence.buffer_m
            assert closest is not None
            assert closest.distance_m > 0.9 * level_m


def test_giving_way_to_a_neighbour_leads_over_no_edge() -> None:
    """Beside the fence, with a neighbour on the inner side ahead."""
    at_the_buffer = np.array([2.0, 16.0, 10.0])
    ahead = neighbour(3, 3.0, 17.5, 10.0)
    wanted = np.array([0.0, 1.0, 0.0])
    free = brake(at_the_buffer, AT_REST, wanted, [ahead], (), LEVEL_2, LIMITS, None)
    assert free[0] < -0.1
    command = brake(at_the_buffer, AT_REST, wanted, [ahead], (), LEVEL_2, LIMITS, FENCE)
    assert command[0] > -1e-6
    assert command @ (1.0, 1.5, 0.0) < 1e-6


@given(vectors(10.0), vectors(10.0), number(0.1, 5.0), number(0.0, 1.0))
def test_acceleration_is_limited_as_a_vector(
    previous: F64, wanted: F64, acceleration: float, dt_s: float
) -> None:
    limited = limit_acceleration(previous, wanted, acceleration, dt_s)
    assert math.dist(limited, previous) <= acceleration * dt_s + 1e-9
    left, whole = math.dist(wanted, limited), math.dist(wanted, previous)
    assert left == pytest.approx(max(whole - acceleration * dt_s, 0.0), abs=1e-9)


def test_height_is_held_with_a_gain_of_one() -> None:
    assert hold_height(10.0, 10.4, 1.0) == pytest.approx(0.4)
    assert hold_height(10.0, 20.0, 1.0) == 1.0
    assert hold_height(10.0, 0.0, 1.0) == -1.0
    assert hold_height(math.nan, 0.0, 1.0) == 0.0


@given(vectors(100.0), vectors(100.0), number(0.5, 5.0))
def test_a_leash_ends_on_the_way_to_the_target(target: F64, position: F64, length_m: float) -> None:
    point = leash(target, position, length_m)
    assert point is not None
    assert math.dist(point, position) <= length_m + 1e-9
    total = math.dist(target, position)
    assert math.dist(point, target) == pytest.approx(max(total - length_m, 0.0), abs=1e-9)


@given(rubbish, rubbish, rubbish, numbers_with_rubbish)
def test_rubbish_in_gives_a_finite_command(a: F64, b: F64, c: F64, d: float) -> None:
    usable = all(abs(x) < 1e6 for x in (*a, *b, *c))
    command, _ = keep_inside(FENCE, a, b, c, LIMITS, False)
    assert np.isfinite(command).all()
    assert usable or not command.any()
    for other in (
        neighbour(1, *AT_REST, age_s=d),
        neighbour(1, *a, velocity_m_s=tuple(b), age_s=0.1),
    ):
        command = brake(a, b, c, [other], [other], LEVEL_2, LIMITS, FENCE)
        closest = nearest((0.0, 0.0, 0.0), [other])
        assert np.isfinite(command).all()
        assert usable or not command.any()
        assert closest is None or math.isfinite(closest.distance_m)
    assert np.isfinite(limit_acceleration(a, b, 2.0, d)).all()
    assert math.isfinite(hold_height(d, 3.0, 1.0))
    assert math.isfinite(approach_speed(d, LIMITS))
    point = leash(a, b, 2.0)
    assert point is None or np.isfinite(point).all()
    assert np.isfinite(limit_speed(np.nan_to_num(a[:2], posinf=1.0, neginf=1.0) % 1e3, 2.0)).all()


def test_an_unknown_neighbour_stops_the_robot_and_hides_no_other() -> None:
    lost = neighbour(1, math.nan, 0.0, 0.0)
    others = [lost, neighbour(2, 9.0, 0.0, 0.0)]
    command = brake(AT_REST, AT_REST, np.array([1.0, 0.0, 0.0]), others, (), LEVEL_2, LIMITS, None)
    assert not command.any()
    assert nearest((0.0, 0.0, 0.0), others) == Closest(2, 9.0)


# In so acute a corner whoever moves inside one line after the other hardly gets on.
@example(
    fence=Fence(((1.46, -51.75), (10.96, -35.5), (15.0, 0.0)), 0.5, floor_m=3.0, ceiling_m=6.0),
    x_m=0.0,
    y_m=14.0,
)
@settings(deadline=None)
@given(fences(), number(-60.0, 60.0), number(-60.0, 60.0))
def test_a_place_is_moved_inside_only_if_it_is_not_and_no_further_than_needed(
    fence: Fence, x_m: float, y_m: float
) -> None:
    depth_m = fence.buffer_m / 2.0
    moved = fence.moved_inside_m(x_m, y_m, depth_m)
    if fence.distance_m(x_m, y_m) >= depth_m:
        assert moved == (x_m, y_m)
    assert fence.distance_m(*moved) >= depth_m - 1e-9
    # Of a convex area the nearest place is the only one from which all of it lies beyond.
    back = np.array([x_m, y_m]) - moved
    assert ((np.array(fence.grown_m(-depth_m)) - moved) @ back <= 1e-6).all()


def test_who_is_above_keeps_a_robot_below() -> None:
    def height_m(*others: Neighbour) -> float:
        return clear_height_m(np.array([0.0, 0.0, 2.0]), others, 1.5)

    assert height_m() == math.inf
    assert height_m(neighbour(1, 1.0, 0.0, 6.0), neighbour(2, 0.0, 2.9, 5.0)) == 3.5
    assert height_m(neighbour(1, 3.1, 0.0, 6.0), neighbour(2, 0.0, 0.0, 1.0)) == math.inf
    falling = neighbour(1, 0.0, 0.0, 6.0, velocity_m_s=(0.0, 0.0, -2.0), age_s=0.5)
    assert height_m(falling) == 3.5
