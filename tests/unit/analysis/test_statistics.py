"""Statistics of results, and their uncertainty."""

import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.core import F64
from lpac.analysis.statistics import (
    Interval95,
    at_most_share,
    bootstrap,
    compare,
    interquartile_mean,
    mean_over_time,
    paired_bootstrap,
    performance_profile,
    ratio_of_means,
    share_below,
    what_would_tell,
)

COSTS = st.just(0.0) | st.floats(0.01, 10.0)


@st.composite
def methods(draw: st.DrawFn, count: int = 1) -> list[F64]:
    """Costs (S, K) of `count` methods over the same K worlds."""
    worlds = draw(st.integers(1, 12))
    shapes = [(draw(st.integers(1, 4)), worlds) for _ in range(count)]
    return [
        np.array(draw(st.lists(COSTS, min_size=s * k, max_size=s * k))).reshape(s, k)
        for s, k in shapes
    ]


@given(st.lists(COSTS, min_size=1, max_size=40), st.randoms())
def test_the_interquartile_mean_leaves_out_a_quarter_on_each_side(values, random) -> None:  # type: ignore[no-untyped-def]
    middle = interquartile_mean(np.array([values]))
    low, high = np.quantile(values, (0.25, 0.75), method="inverted_cdf").tolist()
    assert low - 1e-9 <= middle <= high + 1e-9
    # Four copies of each value, so that no value counts in part.
    ordered = sorted(values * 4)
    kept = ordered[len(values) : 3 * len(values)]
    assert middle == pytest.approx(np.mean(kept))
    # Order and outliers have no effect.
    shuffled = random.sample(values, len(values))
    shuffled[shuffled.index(max(values))] = max(values) + (1e6 if len(values) > 3 else 0.0)
    assert interquartile_mean(np.array([shuffled])) == pytest.approx(middle)


@settings(max_examples=10)
@given(methods())
def test_an_interval_lies_within_the_values(drawn: list[F64]) -> None:
    [values] = drawn
    found = bootstrap(values)
    assert values.min() - 1e-9 <= found.low <= found.high <= values.max() + 1e-9
    assert found.value == pytest.approx(values.mean())
    assert bootstrap(values) == found


@pytest.mark.parametrize("trainings", [1, 4])
def test_an_interval_holds_the_truth_about_as_often_as_it_says(trainings: int) -> None:
    """About 95 % for normal values with different trainings; less with few trainings."""
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(60):
        of_training = rng.normal(0.0, 0.1 if trainings > 1 else 0.0, (trainings, 1))
        found = bootstrap(1.0 + of_training + rng.normal(0.0, 0.2, (trainings, 30)))
        held += found.low <= 1.0 <= found.high
    assert 45 <= held <= 60


@settings(max_examples=10)
@given(methods(2))
def test_who_is_better_does_not_depend_on_who_is_named_first(drawn: list[F64]) -> None:
    a, b = (values.mean(axis=0, keepdims=True) for values in drawn)
    one, other = compare(a, b), compare(b, a)
    swapped = {"a": "b", "b": "a", None: None}
    assert one.better == swapped[other.better]
    assert one.difference.value == pytest.approx(-other.difference.value)
    assert one.difference.low == pytest.approx(-other.difference.high)
    assert one.a_below_b.value == pytest.approx(1.0 - other.a_below_b.value)


@settings(max_examples=10)
@given(methods())
def test_no_method_is_better_than_itself(drawn: list[F64]) -> None:
    [values] = drawn
    same = compare(values, values.copy())
    assert same.better is None and same.difference.value == 0.0
    assert same.a_below_b.value == 0.5


def test_pairs_tell_what_means_do_not() -> None:
    """Worlds differ far more than the methods: only pairs show the difference."""
    rng = np.random.default_rng(0)
    worlds = rng.uniform(0.1, 0.9, (1, 30))
    a, b = worlds - 0.01, worlds + rng.normal(0.0, 0.005, (1, 30))
    assert bootstrap(a).high > bootstrap(b).low
    told = compare(a, b)
    assert told.better == "a" and told.ratio.high < 1.0 and told.a_below_b.value > 0.9
    assert not told.of_methods
    assert compare(a, b, trained_a=False, trained_b=False).of_methods


def test_one_good_training_of_several_proves_nothing() -> None:
    """Resampling worlds alone would favour A, whose trainings differ more than the methods."""
    worlds = np.random.default_rng(0).uniform(0.1, 0.9, (1, 30))
    b = np.repeat(worlds, 3, axis=0)
    a = b + np.array([[-0.1], [0.02], [0.05]])
    assert compare(a.mean(axis=0, keepdims=True), b).better == "a"
    told = compare(a, b)
    assert told.better is None and told.of_methods


def test_the_same_trainings_are_pairs_too() -> None:
    """Trainings differ more than the two ways of flying them."""
    worlds = np.random.default_rng(0).uniform(0.1, 0.9, (1, 30))
    b = worlds + np.array([[-0.1], [0.02], [0.05]])
    a = b - 0.01
    assert compare(a, b).better is None
    told = compare(a, b, same_trainings=True)
    assert told.better == "a" and told.of_methods
    assert told.difference.low == pytest.approx(told.difference.high)
    # Worse with all trainings but one.
    a = b + np.array([[-0.1], [0.02], [0.05]])
    assert compare(a, b, same_trainings=True).better is None
    with pytest.raises(ValueError, match="3 trainings of one and 1 of the other: not the same"):
        compare(a, b[:1], same_trainings=True)


def test_few_worlds_prove_nothing() -> None:
    a = np.full((1, 5), 0.2)
    assert compare(a, a + 0.1).better is None
    assert compare(np.full((1, 6), 0.2), np.full((1, 6), 0.3)).better == "a"


def test_how_many_worlds_would_tell() -> None:
    few = what_would_tell(Interval95(0.1, -0.5, 0.7), 2)
    assert few == "2 worlds are too few: at least 6 are needed, often 50"
    # Four times the number halves the interval, which then ends at 0.
    some = what_would_tell(Interval95(0.1, -0.1, 0.3), 20)
    assert some.endswith("about 80 would show it")
    assert "no difference is visible" in what_would_tell(Interval95(0.0, -0.1, 0.1), 20)
    rng = np.random.default_rng(1)
    a, b = rng.normal(0.0, 1.0, (1, 20)), rng.normal(0.2, 1.0, (1, 20))
    undecided = compare(a, b)
    assert undecided.better is None
    enough = int(re.findall(r"about (\d+)", what_would_tell(undecided.difference, 20))[0])
    repeats = enough // 20 + 1
    assert compare(np.tile(a, repeats), np.tile(b, repeats)).better is not None


def test_only_the_same_worlds_are_pairs() -> None:
    with pytest.raises(ValueError, match="3 worlds of one and 4 of the other: no pairs"):
        paired_bootstrap(np.zeros((1, 3)), np.zeros((1, 4)), ratio_of_means)


def test_ratio_and_share() -> None:
    a, b = np.array([[1.0, 2.0, 3.0]]), np.array([[2.0, 2.0, 2.0]])
    assert ratio_of_means(a, b) == 1.0 and share_below(a, b) == 0.5
    assert math.isnan(ratio_of_means(a, 0.0 * b))
    assert all(map(math.isnan, compare(a, 0.0 * b).ratio))
    # Draws in which all of the other is 0 do not count.
    seldom = compare(a, np.array([[0.0, 0.0, 2.0]])).ratio
    assert 0.0 < seldom.low < seldom.value < seldom.high < math.inf


def test_one_flight_has_no_spread() -> None:
    assert bootstrap(np.array([[0.3]])) == (0.3, 0.3, 0.3)
    one = compare(np.array([[0.3], [0.5]]), np.array([[0.4]]))
    assert one.better is None
    assert (one.difference.low, one.difference.high) == pytest.approx((-0.1, 0.1))


@given(methods(), st.lists(COSTS, min_size=1, max_size=10))
def test_a_profile_counts(drawn: list[F64], thresholds: list[float]) -> None:
    [values] = drawn
    profile = performance_profile(values, np.array(sorted(thresholds)))
    expected = [(values <= threshold).mean() for threshold in sorted(thresholds)]
    np.testing.assert_allclose(profile, expected)


@given(st.lists(st.tuples(st.floats(0.1, 5.0), COSTS, COSTS), min_size=1, max_size=20))
def test_the_area_is_that_of_the_trapezia(steps: list[tuple[float, float, float]]) -> None:
    time_s = np.cumsum([0.0, *(step for step, _, _ in steps)])
    curves = np.array([[1.0, *(a for _, a, _ in steps)], [1.0, *(b for _, _, b in steps)]])
    expected = [np.trapezoid(curve, time_s) / time_s[-1] for curve in curves]
    np.testing.assert_allclose(mean_over_time(time_s, curves), expected)


def test_how_seldom_it_is_at_least() -> None:
    # None of 1,000: "below 0.3 % at 95 % confidence".
    assert at_most_share(1000, 0) == pytest.approx(1.0 - 0.05 ** (1.0 / 1000), abs=1e-5)
    assert 0.0029 < at_most_share(1000, 0) < 0.003
    # Like R's binom.test(3, 100, alternative = "less").
    assert at_most_share(100, 3) == pytest.approx(0.0757, abs=1e-3)
    assert at_most_share(5, 5) == at_most_share(0, 0) == 1.0


@given(st.integers(1, 60), st.integers(0, 60))
def test_the_bound_of_a_share_is_above_what_was_seen(of: int, failed: int) -> None:
    failed = min(failed, of)
    bound = at_most_share(of, failed)
    assert failed / of <= bound <= 1.0
    assert at_most_share(of, max(failed - 1, 0)) <= bound
    assert at_most_share(of + 1, failed) <= bound
