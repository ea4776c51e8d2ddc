"""What came, and how old it was: counts whose differences tell of any time."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.arrivals import AGE_EDGES_S, Arrivals

NONE = Arrivals()
ages_s = st.lists(st.none() | st.floats(0.0, 10.0), max_size=60)


def after(ages_s: list[float | None], begun: Arrivals = NONE) -> Arrivals:
    for age_s in ages_s:
        begun = begun.plus(1, age_s)
    return begun


@given(ages_s)
def test_they_survive_the_way(ages_s: list[float | None]) -> None:
    arrivals = after(ages_s)
    assert Arrivals.of_counts(arrivals.counts) == arrivals
    assert not arrivals.counts or arrivals.counts[-1] > 0


@given(ages_s, ages_s)
def test_the_difference_of_two_is_what_came_between(
    first: list[float | None], then: list[float | None]
) -> None:
    before = after(first)
    assert after(then, before).since(before) == after(then)


@given(ages_s, st.sampled_from(AGE_EDGES_S))
def test_how_many_are_older(ages_s: list[float | None], edge_s: float) -> None:
    dated = [age_s for age_s in ages_s if age_s is not None]
    assert after(ages_s).older_than(edge_s) == sum(age_s >= edge_s for age_s in dated)
    assert after(ages_s).arrived == len(ages_s)


@given(st.lists(st.floats(0.0, 3.2, exclude_max=True), min_size=1), st.floats(0.0, 1.0))
def test_a_share_of_them_came_within_an_age_of_the_same_bin(
    ages_s: list[float], share: float
) -> None:
    told_s = after([*ages_s]).age_s(share)
    assert told_s is not None
    rank = share * len(ages_s)
    # Half of the way between two there are two answers.
    near_s = sorted(ages_s)[max(0, int(rank) - 1) : int(rank) + 1]
    edges_s = (0.0, *AGE_EDGES_S)
    assert any(
        low_s <= told_s <= high_s
        for low_s, high_s in itertools.pairwise(edges_s)
        if any(low_s <= age_s < high_s for age_s in near_s)
    )


def test_ages_within_a_bin_are_spread_evenly() -> None:
    arrivals = after([0.11] * 50 + [0.3] * 49 + [None])
    assert arrivals.age_s(0.25) == pytest.approx(0.1 + 0.1 * 0.25 * 99 / 50)
    assert arrivals.age_s(1.0) == pytest.approx(0.4)
    assert Arrivals().age_s(0.5) is None
    assert after([None]).age_s(0.5) is None
    assert after([7.0]).age_s(0.5) == 3.2, "older than that is all that is known"


def test_a_newer_program_may_know_more_bins() -> None:
    newer = (9, 0, *(0,) * 8, 1, 2, 3)
    assert Arrivals.of_counts(newer).by_age[-1] == 6
    assert Arrivals.of_counts(()) == Arrivals()
