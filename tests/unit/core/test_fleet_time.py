"""A ground's clock by round trips: never further off than it says, whatever the delays are."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.fleet_time import FleetClock, FleetTime

GROUND, OTHER = 7, 8

delays = st.floats(0.0, 10.0)


class Exchange:
    """A robot and its ground, whose clocks differ by `ahead_s` and drift."""

    def __init__(self, ahead_s: float = 0.0, drift: float = 0.0, base: int = GROUND) -> None:
        self.clock = FleetClock()
        self._ahead_s, self._drift, self._base = ahead_s, drift, base

    def ground_s(self, now_s: float) -> float:
        return now_s * (1.0 + self._drift) + self._ahead_s

    def say(self, at_s: float, there_s: float, held_s: float, back_s: float) -> float:
        """A status that is so long on its way, is held, and comes back; when it did."""
        sent_s = at_s + there_s + held_s
        came_s = sent_s + back_s
        self.clock.update(
            self._base, self.ground_s(sent_s), echoed_at_s=at_s, held_s=held_s, now_s=came_s
        )
        return came_s


@given(
    st.floats(-1e6, 1e6),
    st.floats(-1e-4, 1e-4),
    st.lists(st.tuples(delays, st.floats(0.0, 0.3), delays), min_size=1, max_size=8),
    st.floats(0.0, 1000.0),
)
def test_it_is_never_further_off_than_it_says(
    ahead_s: float, drift: float, trips: list[tuple[float, float, float]], silent_s: float
) -> None:
    exchange = Exchange(ahead_s, drift)
    now_s = 0.0
    for there_s, held_s, back_s in trips:
        now_s = exchange.say(now_s, there_s, held_s, back_s)
    now_s += silent_s
    known = exchange.clock.at(now_s)
    assert known is not None and known.base == GROUND
    # The drift while a message travels is not aged.
    allowed_s = known.uncertainty_s + 1e-4 * 21.0 + 1e-6
    assert abs(known.time_s - exchange.ground_s(now_s)) <= allowed_s
    best_s = min(there_s + back_s for there_s, _, back_s in trips)
    assert known.uncertainty_s <= best_s / 2 + 1e-4 * (now_s + 1.0) + 0.0011


@given(delays, st.floats(0.0, 0.2), st.floats(0.0, 0.2), st.floats(-1e6, 1e6))
def test_a_message_is_as_old_as_is_told(
    delay_s: float, one_s: float, other_s: float, ahead_s: float
) -> None:
    sender, receiver = Exchange(ahead_s), Exchange(ahead_s - 3.0)
    # The two robots' own clocks differ by 3 s, and by how long they took to hear the ground.
    sender.say(0.0, one_s, 0.1, other_s)
    receiver.say(3.0, other_s, 0.0, one_s)
    sent = sender.clock.at(10.0)
    assert sent is not None
    age = receiver.clock.age_s(sent, 10.0 + 3.0 + delay_s)
    assert age is not None
    assert age.least_s - 1e-6 <= delay_s <= age.most_s + 1e-6
    assert age.most_s - age.least_s <= 2.0 * (one_s + other_s) + 0.02


def test_without_a_ground_nothing_is_known() -> None:
    clock = FleetClock()
    assert clock.at(1.0) is None
    assert clock.age_s(FleetTime(GROUND, 0.0, 0.0), 1.0) is None


def test_of_another_ground_no_age_is_known() -> None:
    exchange = Exchange()
    exchange.say(0.0, 0.01, 0.0, 0.01)
    assert exchange.clock.age_s(FleetTime(OTHER, 0.0, 0.0), 1.0) is None


def test_the_newest_ground_counts_and_the_one_before_is_understood() -> None:
    exchange = Exchange(base=GROUND)
    exchange.say(0.0, 0.01, 0.0, 0.01)
    exchange.clock.update(OTHER, 500.0, echoed_at_s=1.0, held_s=0.0, now_s=1.0)
    newest = exchange.clock.at(1.0)
    assert newest is not None and (newest.base, newest.time_s) == (OTHER, 500.0)
    age = exchange.clock.age_s(FleetTime(GROUND, 1.0, 0.0), 2.0)
    assert age is not None
    assert (age.least_s, age.most_s) == pytest.approx((0.989, 1.011), abs=1e-3)
    for base in range(100, 110):
        exchange.clock.update(base, 0.0, echoed_at_s=1.0, held_s=0.0, now_s=1.0)
    assert exchange.clock.age_s(FleetTime(GROUND, 1.0, 0.0), 2.0) is None


@pytest.mark.parametrize(
    ("time_s", "echoed_at_s", "held_s"),
    [
        (0.0, 2.0, 0.0),
        (0.0, 0.5, 0.6),
        (0.0, 0.5, -0.1),
        (math.nan, 0.5, 0.0),
        (0.0, 0.5, math.nan),
    ],
)
def test_what_cannot_be_is_not_believed(time_s: float, echoed_at_s: float, held_s: float) -> None:
    clock = FleetClock()
    clock.update(GROUND, time_s, echoed_at_s=echoed_at_s, held_s=held_s, now_s=1.0)
    assert clock.at(1.0) is None
