"""Who fell silent in flight: where it may be, and until when."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.flight.landing import may_stand
from edge.flight.silence import SilenceLimits, highest_still_m, last_word, nearest_on_way_m
from edge.messages.mission import FlightState
from tests.unit.flight.test_preflight import NEIGHBOUR

LIMITS = SilenceLimits(max_speed_m_s=1.25, ceiling_m=34.5, flies_on_s=4.6, hovers_s=66.0)
FLYING = replace(
    NEIGHBOUR, state=FlightState.MISSION, armed=True, position_m=(3.0, 4.0, 9.0),
    velocity_m_s=(1.0, 0.0, -0.2),
)  # fmt: skip
coordinates = st.floats(-100.0, 100.0)


def test_it_is_where_it_said_and_as_high_as_it_was_to_climb() -> None:
    said = last_word(FLYING, LIMITS)
    assert said is not None
    assert (said.position_m, said.velocity_m_s) == ((3.0, 4.0, 9.0), (1.0, 0.0, 0.0))
    climbs = last_word(replace(FLYING, state=FlightState.TAKEOFF, slot_height_m=14.0), LIMITS)
    assert climbs is not None and climbs.position_m == (3.0, 4.0, 14.0)


@pytest.mark.parametrize(
    "beacon",
    [replace(FLYING, armed=False), replace(FLYING, armed=None), replace(FLYING, position_m=None)],
)
def test_who_does_not_fly_or_tells_no_place_is_nowhere(beacon: object) -> None:
    assert last_word(beacon, LIMITS) is None  # type: ignore[arg-type]


def test_nobody_is_believed_to_be_higher_or_faster_than_it_can_be() -> None:
    said = last_word(
        replace(FLYING, position_m=(0.0, 0.0, 8e4), velocity_m_s=(0.0, 327.0, 0.0)), LIMITS
    )
    assert said is not None
    assert said.position_m[2] == LIMITS.ceiling_m
    assert said.velocity_m_s[:2] == pytest.approx((0.0, LIMITS.max_speed_m_s))


def test_it_is_down_when_it_must_have_come_down() -> None:
    said = last_word(FLYING, LIMITS)
    assert said is not None
    heights_m = [highest_still_m(said._replace(age_s=t), LIMITS) for t in (2.0, 66.0, 76.0, 84.1)]
    assert heights_m == pytest.approx([9.0, 9.0, 4.0, -0.05])


@given(coordinates, coordinates, st.floats(0.0, 100.0))
def test_it_may_have_stopped_anywhere_on_its_way(x_m: float, y_m: float, age_s: float) -> None:
    said = last_word(FLYING, LIMITS)
    assert said is not None
    place_m = np.array([x_m, y_m])
    near_m = nearest_on_way_m(said._replace(age_s=age_s), LIMITS, place_m)
    stops_m = np.array([3.0, 4.0]) + np.outer(
        np.linspace(0.0, min(age_s, LIMITS.flies_on_s), 101), [1.0, 0.0]
    )
    assert np.hypot(*(near_m - place_m)) == pytest.approx(
        np.hypot(*(stops_m - place_m).T).min(), abs=0.03
    )


def test_in_the_end_it_stands_there() -> None:
    said = last_word(FLYING, LIMITS)
    assert said is not None
    stands = may_stand(said._replace(age_s=90.0), (3.0, 3.0), (5.0, 9.0), LIMITS)
    assert {each.robot_id for each in stands} == {2}
    assert [each.place_m for each in stands] == [(3.0, 4.0), (7.6, 4.0), (5.0, 4.0)]
    # Whether it has landed on its own is not known: its landing point is within 2 m of one.
    assert [each.is_on_its_own for each in stands] == [True, False, False]
