"""Margins: with all errors at their worst nobody touches; with clearly less room somebody does."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.core import F64
from edge.core.fence import Fence
from edge.flight.margins import ErrorBudget, places_apart
from edge.flight.safety import MotionLimits, keep_inside, limit_acceleration
from edge.flight.state import FlightParameters
from lpac.sim.px4.errors import Errors, draw_bias_m
from tests.unit.flight.test_safety import CONTROL_S, SQUARE, Vehicle

LIMITS = MotionLimits(1.25, 2.0, 2.0, 1.3)
REACTION_S = 0.5
DEFAULT = ErrorBudget()
# So much less is clearly too little.
LESS = 0.8


def number(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False)


sizes = number(0.01, 6.0)
budgets = st.builds(ErrorBudget, *[sizes] * len(dataclasses.fields(ErrorBudget)))
shares = number(-1.0, 1.0)
directions = number(0.0, math.tau)


def vector(size_m: float, share: float, direction: float) -> F64:
    """(2,): an error of at most that size, some way."""
    return share * size_m * np.array([math.cos(direction), math.sin(direction)])


errors = st.tuples(shares, directions)


@given(budgets, budgets, directions, errors, errors, errors, errors)
def test_at_the_least_distance_two_that_land_do_not_touch(
    one: ErrorBudget,
    other: ErrorBudget,
    bearing: float,
    one_gps: tuple[float, float],
    one_wind: tuple[float, float],
    other_gps: tuple[float, float],
    other_wind: tuple[float, float],
) -> None:
    """Each is where it wants to be by its own estimate, and the wind carries it from there."""
    apart_m = places_apart(one.position_m, other.position_m).least_m
    one_m = vector(one.gps_m, *one_gps) + vector(one.wind_m, *one_wind)
    other_m = vector(other.gps_m, *other_gps) + vector(other.wind_m, *other_wind)
    truly_m = np.hypot(*(vector(apart_m, 1.0, bearing) + other_m - one_m))
    assert truly_m > (one.drone_m + other.drone_m) / 2.0 - 1e-9


@given(budgets, *[shares] * 7)
def test_at_the_least_spacing_two_above_each_other_do_not_touch(
    budget: ErrorBudget,
    common: float,
    later: float,
    difference: float,
    held_one: float,
    held_other: float,
    ground: float,
    share: float,
) -> None:
    """What two vehicles' heights are wrong by may be split between them in any way."""
    together_m = common * budget.height_common_m
    apart_m = difference * budget.height_apart_m + later * budget.takeoffs_height_m
    lower_m = together_m - apart_m * share + held_one * budget.height_control_m
    upper_m = budget.slot_spacing.least_m + together_m + apart_m * (1.0 - share)
    upper_m += held_other * budget.height_control_m + ground * budget.pads_height_m
    assert upper_m - lower_m > budget.drone_m - 1e-9


@given(budgets)
def test_within_the_takeoffs_window_heights_walk_no_further_than_allowed(
    budget: ErrorBudget,
) -> None:
    window_s = budget.takeoffs_window_s
    if budget.height_common_m == 0.0:
        assert window_s == math.inf
    else:
        walked_m = budget.height_common_m * window_s / 300.0
        assert walked_m == pytest.approx(budget.takeoffs_height_m)
    assert DEFAULT.takeoffs_window_s == pytest.approx(50.0)
    assert ErrorBudget(height_common_m=0.0).takeoffs_window_s == math.inf


def test_heights_that_err_count_where_robots_pass_each_other_and_where_they_fall() -> None:
    # 2 m of two estimates, 0.5 m of the time between takeoffs, 0.5 m of pads, and a drone.
    assert DEFAULT.passing_height_m == pytest.approx(3.5)
    exact = dataclasses.replace(
        DEFAULT, height_common_m=0.0, height_apart_m=0.0, height_control_m=0.0
    )
    around_m = exact.free_ground(LIMITS, 5.0, 25.0 + DEFAULT.height_m).least_m
    assert DEFAULT.free_ground(LIMITS, 5.0, 25.0).least_m == around_m
    assert places_apart(1.0, 1.0).or_at_least(3.0, "more").least_m == 3.0


@pytest.mark.parametrize("share", [1.0, LESS])
def test_the_margins_are_no_padding(share: float) -> None:
    """All errors that are stated, at once, the wrong way round: that is where margins end."""
    budget = DEFAULT
    towards_m = 2.0 * (budget.gps_m + budget.wind_m)
    beside_m = share * places_apart(budget.position_m, budget.position_m).least_m - towards_m
    down_m = budget.height_apart_m + budget.takeoffs_height_m + budget.pads_height_m
    down_m += 2.0 * budget.height_control_m
    above_m = share * budget.slot_spacing.least_m - down_m
    for truly_m in (beside_m, above_m):
        assert (truly_m >= budget.drone_m) is (share == 1.0)


def test_a_day_of_flights_by_chance() -> None:
    """Errors drawn at random within the budget: 100,000 landings of two, and of two heights.

    What was shipped before, landing points 2 m apart and heights 2 m apart, is no margin.
    """
    rng = np.random.default_rng(7)
    n, budget = 100_000, DEFAULT

    def drawn_m(size_m: float) -> F64:
        """(n, 2), uniform over the disk."""
        radius_m, way = size_m * np.sqrt(rng.uniform(size=n)), rng.uniform(0.0, math.tau, n)
        return np.stack([radius_m * np.cos(way), radius_m * np.sin(way)], axis=1)

    errors_m = sum(
        (drawn_m(size_m) for size_m in 2 * (budget.gps_m, budget.wind_m)), np.zeros((n, 2))
    )
    heights_m = sum(
        (
            rng.uniform(-size_m, size_m, n)
            for size_m in (
                budget.height_apart_m, budget.height_control_m, budget.height_control_m,
                budget.takeoffs_height_m, budget.pads_height_m,
            )
        ),
        np.zeros(n),
    )  # fmt: skip

    def touched(landing_m: float, spacing_m: float) -> tuple[int, int]:
        beside = np.linalg.norm(errors_m + np.array([landing_m, 0.0]), axis=1) < budget.drone_m
        above = np.abs(heights_m + spacing_m) < budget.drone_m
        return int(beside.sum()), int(above.sum())

    apart_m = places_apart(budget.position_m, budget.position_m).least_m
    assert touched(apart_m, budget.slot_spacing.least_m) == (0, 0)
    for touching in touched(2.0, 2.0):
        assert touching > n / 100


def nearest_in_truth_m(fleet: int, spacing_m: float) -> float:
    """Of ten simulated vehicles above each other for ten minutes, armed within half a minute.

    Each holds its height by its own estimate, on a pad as high as the others.
    """
    vehicles = [Errors(100 * fleet + i, fleet) for i in range(10)]
    armed_s = np.linspace(10.0, 35.0, len(vehicles))
    walked_m = [
        [its.height_m(at_s) - its.height_m(began_s) for at_s in np.arange(40.0, 640.0, 10.0)]
        for its, began_s in zip(vehicles, armed_s, strict=True)
    ]
    heights_m = spacing_m * np.arange(len(vehicles))[:, None] + np.array(walked_m)
    return float(np.diff(heights_m, axis=0).min())


def test_heights_of_simulated_vehicles_stay_apart_in_truth() -> None:
    fleets = range(100)
    least_m = DEFAULT.drone_m + 2.0 * DEFAULT.height_control_m + DEFAULT.pads_height_m
    nearest_m = [nearest_in_truth_m(fleet, DEFAULT.slot_spacing.least_m) for fleet in fleets]
    assert min(nearest_m) >= least_m
    # Where control and pads are wrong too, clearly less is too little.
    assert min(nearest_m) < least_m + (1.0 - LESS) * DEFAULT.slot_spacing.least_m
    # 2 m, as flown before, are so without that: docs/faults.md tells how often.
    assert sum(nearest_in_truth_m(fleet, 2.0) < DEFAULT.drone_m for fleet in fleets) == 13


def test_simulated_vehicles_land_apart_in_truth() -> None:
    """At places as they measured them, in a row, up to ten minutes later."""
    rng = np.random.default_rng(3)
    apart_m = places_apart(DEFAULT.position_m, DEFAULT.position_m).least_m
    pushed_m = 2.0 * DEFAULT.wind_m + DEFAULT.drone_m
    for fleet in range(30):
        landed_m = []
        for i in range(10):
            errors = Errors(100 * fleet + i, fleet)
            bias_m = (*draw_bias_m(*rng.uniform((0.0, 0.0), (1.0, math.tau))), 0.0)
            walked_m = np.array(errors.position_m(rng.uniform(60.0, 600.0), bias_m))
            walked_m = walked_m - errors.position_m(0.0, bias_m)
            landed_m.append(np.array([i * apart_m, 0.0]) - walked_m[:2])
        between_m = np.linalg.norm(np.diff(landed_m, axis=0), axis=1)
        assert between_m.min() >= pushed_m


def test_what_ships_holds_exactly_what_the_default_budget_asks_for() -> None:
    parameters = FlightParameters(slot=0, landing_point_m=(0.0, 0.0))
    assert DEFAULT.slot_spacing.least_m == parameters.slot_spacing_m == 4.5
    assert 2.0 * DEFAULT.position_m == places_apart(4.0, 4.0).least_m == 8.0
    assert DEFAULT.lowest_height.least_m == 4.75
    assert DEFAULT.lowest_height.holds(parameters.base_height_m)


@settings(deadline=None, max_examples=40)
@given(st.integers(5, 60), directions, directions, shares)
def test_a_program_that_hangs_stops_within_the_fence_however_the_wind_blows(
    hangs_at: int, heading: float, gust: float, share: float
) -> None:
    buffer_m = DEFAULT.fence_buffer(LIMITS, REACTION_S).least_m
    fence = Fence(SQUARE, buffer_m, 2.0, 20.0)
    vehicle = Vehicle(np.array([16.0, 12.0, 5.0]), LIMITS.lag_s, LIMITS.max_acceleration_m_s2)
    wanted = np.array([*vector(LIMITS.max_speed_m_s, 1.0, heading), 0.0])
    command, recovering, still = np.zeros(3), False, np.zeros(3)
    wind_m = vector(DEFAULT.wind_m, share, gust)
    hangs_at *= 4
    for tick in range(hangs_at + 60):
        if tick < hangs_at:
            command = limit_acceleration(command, wanted, LIMITS.max_acceleration_m_s2, CONTROL_S)
            command, recovering = keep_inside(
                fence, vehicle.position_m, vehicle.velocity_m_s, command, LIMITS, recovering
            )
        elif tick >= hangs_at + round(REACTION_S / CONTROL_S):
            command = still
        for at in vehicle.fly(command, still):
            assert fence.distance_m(*(at[:2] + wind_m)) >= 0.0


def test_px4s_fence_lies_beyond_the_way_to_stop() -> None:
    """v lag + v^2 / 2a = 1.25 x 1.3 + 1.25^2 / 4 = 2.02 m, and the wind."""
    margin = DEFAULT.px4_fence(LIMITS)
    assert margin.least_m == pytest.approx(2.0156 + 0.75, abs=1e-3)
    assert str(margin) == (
        "must be 2.77 m (it stops from 1.25 m/s within 2 m, and wind carries it 0.75 m)"
    )


@settings(deadline=None, max_examples=60)
@given(directions, directions, number(0.0, 1.0), number(0.0, 1.0), number(10.0, 40.0))
def test_what_falls_beyond_px4s_fence_falls_where_nobody_is(
    heading: float, wind: float, speed: float, height: float, terminal_m_s: float
) -> None:
    """In any wind of the budget, from any height below the ceiling and its error, with drag."""
    ceiling_m, px4_fence_m = 30.0, 5.0
    free_m = DEFAULT.free_ground(LIMITS, px4_fence_m, ceiling_m).least_m
    at_m = np.array([DEFAULT.position_m + px4_fence_m, 0.0, height * (ceiling_m + 4.5)])
    at_m[0] += 2.0156
    air_m_s = np.array([*vector(DEFAULT.wind_m_s, 1.0, wind), 0.0])
    velocity_m_s = np.array([*vector(LIMITS.max_speed_m_s, speed, heading), 0.0])
    while at_m[2] > 0.0:
        through_m_s = velocity_m_s - air_m_s
        drag = 9.81 * np.linalg.norm(through_m_s) / terminal_m_s**2 * through_m_s
        velocity_m_s = velocity_m_s + (np.array([0.0, 0.0, -9.81]) - drag) * 0.05
        at_m = at_m + velocity_m_s * 0.05
    assert math.hypot(at_m[0], at_m[1]) <= free_m


@given(number(0.0, 50.0), budgets)
def test_a_report_only_ever_asks_for_more(accuracy_m: float, budget: ErrorBudget) -> None:
    reported_m = budget.reported_position_m(accuracy_m)
    assert reported_m >= budget.position_m
    assert reported_m >= 2.0 * accuracy_m + budget.wind_m
    # Nothing reported is no confirmation of a receiver with corrections.
    assert budget.reported_position_m(None) == pytest.approx(
        max(budget.position_m, DEFAULT.gps_m + budget.wind_m + budget.drone_m / 2.0)
    )
