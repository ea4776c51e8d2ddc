"""Robots that fell silent in flight: where they may be, and until when."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from edge.core.fence import Fence
from edge.flight.landing import place_to_land, possible_landings, standing_robots
from edge.flight.margins import ErrorBudget
from edge.flight.silence import (
    SilenceLimits,
    deviation_m,
    highest_possible_m,
    last_state,
    nearest_place_m,
    possible_places_m,
)
from edge.messages.beacon import Beacon
from edge.messages.mission import FlightState
from tests.unit.flight.test_preflight import NEIGHBOUR

LIMITS = SilenceLimits(max_speed_m_s=1.25, ceiling_m=34.5, flies_on_s=4.6, hovers_s=66.0)
FLYING = replace(
    NEIGHBOUR, state=FlightState.MISSION, armed=True, position_m=(3.0, 4.0, 9.0),
    velocity_m_s=(1.0, 0.0, -0.2),
)  # fmt: skip
coordinates = st.floats(-100.0, 100.0)


def test_it_is_where_it_said_and_as_high_as_it_was_to_climb() -> None:
    said = last_state(FLYING, LIMITS)
    assert said is not None
    assert (said.position_m, said.velocity_m_s) == ((3.0, 4.0, 9.0), (1.0, 0.0, 0.0))
    for state in (FlightState.ARMING, FlightState.TAKEOFF, FlightState.RETURN):
        for slot_height_m, height_m in ((14.0, 14.0), (5.0, 9.0)):
            climbs = last_state(replace(FLYING, state=state, slot_height_m=slot_height_m), LIMITS)
            assert climbs is not None and climbs.position_m == (3.0, 4.0, height_m)


@pytest.mark.parametrize(
    "beacon",
    [replace(FLYING, armed=False), replace(FLYING, armed=None), replace(FLYING, position_m=None)],
)
def test_who_does_not_fly_or_tells_no_place_is_nowhere(beacon: object) -> None:
    assert last_state(beacon, LIMITS) is None  # type: ignore[arg-type]


def test_nobody_is_believed_to_be_higher_or_faster_than_it_can_be() -> None:
    said = last_state(
        replace(FLYING, position_m=(0.0, 0.0, 8e4), velocity_m_s=(0.0, 327.0, 0.0)), LIMITS
    )
    assert said is not None
    assert said.position_m[2] == LIMITS.ceiling_m
    assert said.velocity_m_s[:2] == pytest.approx((0.0, LIMITS.max_speed_m_s))


def test_it_is_down_when_it_must_have_come_down() -> None:
    said = last_state(FLYING, LIMITS)
    assert said is not None
    heights_m = [
        highest_possible_m(structs.replace(said, age_s=t), LIMITS) for t in (2.0, 66.0, 76.0, 84.1)
    ]
    assert heights_m == pytest.approx([9.0, 9.0, 4.0, -0.05])


@given(coordinates, coordinates, st.floats(0.0, 100.0))
def test_it_may_have_stopped_anywhere_on_its_way(x_m: float, y_m: float, age_s: float) -> None:
    said = last_state(FLYING, LIMITS)
    assert said is not None
    apart_m = np.hypot(
        *np.diff(possible_places_m(structs.replace(said, age_s=age_s), LIMITS), axis=0).T
    )
    assert (apart_m <= 2.0 + 1e-9).all()
    place_m = np.array([x_m, y_m])
    near_m = nearest_place_m(structs.replace(said, age_s=age_s), LIMITS, place_m)
    way_m = np.array([3.0, 4.0]) + np.outer(
        np.linspace(0.0, min(age_s, LIMITS.flies_on_s), 101), [1.0, 0.0]
    )
    assert np.hypot(*(near_m - place_m)) == pytest.approx(
        np.hypot(*(way_m - place_m).T).min(), abs=0.03
    )


@given(st.floats(0.5, 4.0), coordinates, coordinates)
def test_in_the_end_it_stands_on_its_way(speed_m_s: float, x_m: float, y_m: float) -> None:
    limits = LIMITS._replace(max_speed_m_s=speed_m_s)
    said = last_state(replace(FLYING, velocity_m_s=(speed_m_s, 0.0, 0.0)), limits)
    assert said is not None
    # Where it leads is taken from the first moment on, so that a place that is chosen stays.
    stands = possible_landings(structs.replace(said, age_s=0.1), (3.0, 3.0), limits)
    ends_m = [stands[0].place_m, stands[-1].place_m]
    assert ends_m[0] == (3.0, 4.0)
    assert ends_m[1] == pytest.approx((3.0 + speed_m_s * limits.flies_on_s, 4.0))
    # Who is 8 m from all of them is nearly as far from the line, which the brake keeps it from.
    near_m = nearest_place_m(structs.replace(said, age_s=90.0), limits, np.array([x_m, y_m]))
    to_line_m = float(np.hypot(*(near_m - (x_m, y_m))))
    to_places_m = min(np.hypot(*(np.array(each.place_m) - (x_m, y_m))) for each in stands)
    assert to_line_m**2 >= to_places_m**2 - 1.0 - 1e-6


def test_who_flew_may_have_turned_and_who_hovered_may_not() -> None:
    said = last_state(FLYING, LIMITS)
    assert said is not None
    strayed_m = [
        deviation_m(structs.replace(said, age_s=age_s), LIMITS) for age_s in (0.0, 1.0, 90.0)
    ]
    assert strayed_m == pytest.approx([0.0, 0.5, 0.5 * LIMITS.flies_on_s])
    hovers = structs.replace(said, velocity_m_s=(0.0, 0.0, 0.0), age_s=90.0)
    assert deviation_m(hovers, LIMITS) == 0.0
    (stands,) = possible_landings(hovers, (16.0, 8.0), LIMITS)
    assert stands.away_m((3.0, 14.0)) == 10.0
    assert possible_landings(said, (16.0, 8.0), LIMITS)[0].away_m((3.0, 14.0)) == pytest.approx(
        10.0 - 0.5 * LIMITS.flies_on_s
    )


PADS_M = [(31.0, 21.0), (31.6, 30.4), (4.0, 4.0), (4.0, 14.0)]
FENCE = Fence(((-2.0, -2.0), (34.0, -2.0), (34.0, 34.0), (-2.0, 34.0)), 1.5, 2.0, 30.0)


def beside(pad_m: tuple[float, float], *others: Beacon) -> tuple[float, float] | None:
    """Where it lands while one that fell silent may stand at its pad."""
    said = last_state(
        replace(FLYING, position_m=(27.0, 26.7, 14.0), velocity_m_s=(0.8, 0.0, 0.0)), LIMITS
    )
    assert said is not None
    return place_to_land(
        pad_m,
        None,
        [*possible_landings(said, (16.0, 8.0), LIMITS), *standing_robots(others)],
        PADS_M,
        FENCE,
        ErrorBudget(),
    )


def test_who_comes_later_lands_beside_who_landed_beside() -> None:
    place_m = beside(PADS_M[0])
    assert place_m is not None
    lands = replace(
        FLYING, state=FlightState.LAND, position_m=(*place_m, 4.0), landing_point_m=PADS_M[1]
    )
    other_m = beside(PADS_M[0], lands)
    assert other_m is not None and math.dist(other_m, place_m) >= 8.0
