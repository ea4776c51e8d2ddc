"""Statistics of results over worlds and trainings; less is better throughout.

Values of a method are (S, K): of S trainings, which differ in their seed alone, over the same K
worlds. A method of one training, such as a baseline, is (1, K). Worlds are drawn, and so are
trainings: an interval is about the method only as far as it has several.

Sources: interquartile mean, stratified bootstrap and performance profiles as Agarwal et al., "Deep
Reinforcement Learning at the Edge of the Statistical Precipice" (arXiv 2108.13264); the bound of a
share: Clopper and Pearson, Biometrika 26 (1934).
"""

import math
import warnings
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy  # its parts are loaded on first use: scipy.stats takes a second

from edge.core import F64

CONFIDENCE = 0.95
# A claim about a method, and not about these of its trainings, needs so many.
LEAST_TRAININGS = 3
# Of fewer not even a difference of one sign in all of them would be telling: 2 * 0.5^5 > 0.05.
LEAST_WORLDS = 6
# By what `compare` calls one better, for people.
VERDICT_RULE = (
    f"one is better if the 95 % interval of the difference of their mean costs, over the same "
    f"worlds, leaves 0 out, and there are {LEAST_WORLDS} worlds or more"
)
_RESAMPLES = 2000
_SEED = 0


class Interval95(NamedTuple):
    """A value and the ends of its 95 % interval; `low <= high`."""

    value: float
    low: float
    high: float


def mean(values: F64) -> F64:
    """(...,): of each (..., S, K)."""
    means: F64 = values.mean(axis=(-2, -1))
    return means


def interquartile_mean(values: F64) -> F64:
    """(...,): of each (..., S, K) the mean of the middle half of all its values.

    Where a quartile is inside a value's share, the value counts in part.
    """
    ordered = np.sort(values.reshape(*values.shape[:-2], -1), axis=-1)
    edges = np.clip(np.linspace(0.0, 1.0, ordered.shape[-1] + 1), 0.25, 0.75)
    means: F64 = ordered @ np.diff(edges) / 0.5
    return means


def difference_of_means(a: F64, b: F64) -> F64:
    """(...,): of each (..., S, K) and (..., T, K); below 0 where `a` is better."""
    return mean(a) - mean(b)


def ratio_of_means(a: F64, b: F64) -> F64:
    """(...,): of each (..., S, K) and (..., T, K); below 1 where `a` is better.

    NaN where all of `b` is 0.
    """
    below = mean(b)
    return mean(a) / np.where(below == 0.0, np.nan, below)


def share_below(a: F64, b: F64) -> F64:
    """(...,): in which share of the K worlds the mean of `a` over its trainings is below `b`'s.

    Of each (..., S, K) and (..., T, K); equal ones count half.
    """
    offset = a.mean(axis=-2) - b.mean(axis=-2)
    shares: F64 = (offset < 0.0).mean(axis=-1) + 0.5 * (offset == 0.0).mean(axis=-1)
    return shares


def bootstrap(values: F64, statistic: Callable[[F64], F64] = mean) -> Interval95:
    """A statistic of (S, K), with the interval over other worlds and other trainings."""
    return _interval(lambda *drawn: statistic(_taken(values, *drawn)), *values.shape)


def paired_bootstrap(
    a: F64, b: F64, statistic: Callable[[F64, F64], F64], *, same_trainings: bool = False
) -> Interval95:
    """A statistic of two methods, (S, K) and (T, K), over the same worlds in the same order.

    Worlds are drawn for both at once. Trainings are drawn for each by itself; or for both at once,
    if they are the same, in the same order, and only fly otherwise. Raises ValueError if what is
    drawn for both differs in number.
    """
    if a.shape[1] != b.shape[1]:
        raise ValueError(f"{a.shape[1]} worlds of one and {b.shape[1]} of the other: no pairs")
    if same_trainings and len(a) != len(b):
        raise ValueError(f"{len(a)} trainings of one and {len(b)} of the other: not the same")
    if same_trainings:
        return _interval(lambda *drawn: statistic(_taken(a, *drawn), _taken(b, *drawn)), *a.shape)
    return _interval(
        lambda of_a, of_b, worlds: statistic(_taken(a, of_a, worlds), _taken(b, of_b, worlds)),
        len(a), *b.shape,
    )  # fmt: skip


class Verdict(NamedTuple):
    """Whether method A is better than B over the same worlds.

    `difference` and `ratio` are those of the means; `a_below_b` is the share of the worlds where
    A's mean over its trainings is less, equal ones counting half. `better` is None if the data do
    not tell: the difference's interval has 0 in it, or there are too few worlds. `of_methods` is
    whether both have trainings enough for a claim about the methods; baselines need none.
    """

    better: Literal["a", "b"] | None
    difference: Interval95
    ratio: Interval95
    a_below_b: Interval95
    of_methods: bool


def compare(
    a: F64,
    b: F64,
    *,
    trained_a: bool = True,
    trained_b: bool = True,
    same_trainings: bool = False,
) -> Verdict:
    """Compare (S, K) with (T, K) over the same worlds; see `paired_bootstrap`, also for errors."""

    def told(statistic: Callable[[F64, F64], F64]) -> Interval95:
        return paired_bootstrap(a, b, statistic, same_trainings=same_trainings)

    difference = told(difference_of_means)
    better: Literal["a", "b"] | None = None
    if a.shape[1] >= LEAST_WORLDS and difference.high < 0.0:
        better = "a"
    elif a.shape[1] >= LEAST_WORLDS and difference.low > 0.0:
        better = "b"
    return Verdict(
        better,
        difference,
        told(ratio_of_means),
        told(share_below),
        all(
            not trained or len(values) >= LEAST_TRAININGS
            for values, trained in ((a, trained_a), (b, trained_b))
        ),
    )


def what_would_tell(difference: Interval95, worlds: int) -> str:
    """How many worlds would show which of two is better, where `worlds` do not; for people.

    `difference` is the verdict's: intervals shrink with the root of the number of worlds.
    """
    if worlds < LEAST_WORLDS:
        few = f"{worlds} worlds are" if worlds > 1 else "one world is"
        return f"{few} too few to tell: at least {LEAST_WORLDS} are needed, and 50 often are"
    value, low, high = difference
    width = max(high - value, value - low)
    if not abs(value) > 0.001 * width:
        return f"{worlds} worlds do not tell: no difference is seen in them"
    enough = max(worlds + 1, math.ceil(worlds * (width / abs(value)) ** 2))
    return f"{worlds} worlds do not tell: if the difference is as it looks, about {enough} would"


def performance_profile(values: F64, thresholds: F64) -> F64:
    """(len(thresholds),): the share of all values that are at most as much; it never falls."""
    ordered = np.sort(values, axis=None)
    return np.searchsorted(ordered, thresholds, side="right") / len(ordered)


def mean_over_time(time_s: F64, curves: F64) -> F64:
    """(...,): the area under curves (..., T) at times (T,), ascending, over their duration."""
    means: F64 = np.trapezoid(curves, time_s) / (time_s[-1] - time_s[0])
    return means


def at_most_share(of: int, failed: int) -> float:
    """The greatest share of failures that is still likely, at 95 % confidence, one-sided.

    Clopper and Pearson's bound; of n without any it is 1 - 0.05^(1/n), about 3 / n.
    """
    if of == 0:
        return 1.0
    test = scipy.stats.binomtest(failed, of, alternative="less")
    return float(test.proportion_ci(CONFIDENCE, method="exact").high)


def _taken(values: F64, trainings: Any, worlds: Any) -> F64:
    """(..., S, K): of (S', K') values those of trainings (..., S) and worlds (..., K)."""
    taken: F64 = values[trainings[..., :, None], worlds[..., None, :]]
    return taken


def _interval(statistic: Callable[..., F64], *counts: int) -> Interval95:
    """Bootstrap a statistic of indices: (..., n) for each of the `counts`, drawn independently.

    Draws whose statistic is NaN do not count; the interval is NaN if no other is left.
    """
    whole = dict(enumerate(map(np.arange, counts)))
    # scipy draws from no sample of one.
    several = [place for place, count in enumerate(counts) if count > 1]

    def of_drawn(*drawn: Any, axis: int) -> F64:
        return statistic(*(whole | dict(zip(several, drawn, strict=True))).values())

    value = float(statistic(*whole.values()))
    if not several:
        return Interval95(value, value, value)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", scipy.stats.DegenerateDataWarning)  # of NaN
        found = scipy.stats.bootstrap(
            [whole[place] for place in several], of_drawn, n_resamples=_RESAMPLES,
            vectorized=True, method="percentile", rng=_SEED,
        )  # fmt: skip
    known = found.bootstrap_distribution[~np.isnan(found.bootstrap_distribution)]
    if not len(known):
        return Interval95(math.nan, math.nan, math.nan)
    beyond = (1.0 - CONFIDENCE) / 2.0
    low, high = np.quantile(known, (beyond, 1.0 - beyond)).tolist()
    return Interval95(value, low, high)
