"""Statistics of results over worlds and trainings; less is better throughout.

A method's values are (S, K): S trainings that differ only in their seed, over the same K worlds. A
method with one training, such as a baseline, is (1, K). Both worlds and trainings are resampled: an
interval is about the method only if there are several trainings.

Sources: interquartile mean, stratified bootstrap and performance profiles as in Agarwal et al.,
"Deep Reinforcement Learning at the Edge of the Statistical Precipice" (arXiv 2108.13264); the bound
of a share: Clopper and Pearson, Biometrika 26 (1934).
"""

import math
import warnings
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy  # its parts are loaded on first use: scipy.stats takes a second

from edge.core import F64

CONFIDENCE = 0.95
# Number of trainings needed for a claim about a method rather than these trainings.
LEAST_TRAININGS = 3
# With fewer, even a difference of one sign in all worlds is not significant: 2 * 0.5^5 > 0.05.
LEAST_WORLDS = 6
# Rule of `compare`, for people.
VERDICT_RULE = (
    f"one is better if the 95 % interval of the difference of their mean costs, over the same "
    f"worlds, leaves 0 out, and there are {LEAST_WORLDS} worlds or more"
)
_RESAMPLES = 2000
_SEED = 0


def finite(value: float) -> float | None:
    """The value; None, as JSON has it, if it is not finite."""
    return float(value) if math.isfinite(value) else None


class Interval95(NamedTuple):
    """A value and the ends of its 95 % interval; `low <= high`."""

    value: float
    low: float
    high: float


def mean(values: F64) -> F64:
    """Mean (...,) of values (..., S, K)."""
    means: F64 = values.mean(axis=(-2, -1))
    return means


def interquartile_mean(values: F64) -> F64:
    """Mean (...,) of the middle half of values (..., S, K).

    A value at the quartile counts in part.
    """
    ordered = np.sort(values.reshape(*values.shape[:-2], -1), axis=-1)
    edges = np.clip(np.linspace(0.0, 1.0, ordered.shape[-1] + 1), 0.25, 0.75)
    means: F64 = ordered @ np.diff(edges) / 0.5
    return means


def difference_of_means(a: F64, b: F64) -> F64:
    """Difference (...,) of (..., S, K) and (..., T, K); below 0 where `a` is better."""
    return mean(a) - mean(b)


def ratio_of_means(a: F64, b: F64) -> F64:
    """Ratio (...,) of (..., S, K) and (..., T, K); below 1 where `a` is better.

    NaN where all of `b` is 0.
    """
    below = mean(b)
    return mean(a) / np.where(below == 0.0, np.nan, below)


def share_below(a: F64, b: F64) -> F64:
    """Share (...,) of the K worlds where the mean of `a` over its trainings is below that of `b`.

    Arguments are (..., S, K) and (..., T, K); equal means count half.
    """
    offset = a.mean(axis=-2) - b.mean(axis=-2)
    shares: F64 = (offset < 0.0).mean(axis=-1) + 0.5 * (offset == 0.0).mean(axis=-1)
    return shares


def bootstrap(values: F64, statistic: Callable[[F64], F64] = mean) -> Interval95:
    """A statistic of (S, K), with its interval over worlds and trainings."""
    return _interval(lambda *drawn: statistic(_select(values, *drawn)), *values.shape)


def paired_bootstrap(
    a: F64, b: F64, statistic: Callable[[F64, F64], F64], *, same_trainings: bool = False
) -> Interval95:
    """A statistic of two methods, (S, K) and (T, K), over the same worlds in the same order.

    Worlds are resampled jointly. Trainings are resampled independently, or jointly with
    `same_trainings`, where S = T are the same trainings in the same order. Raises ValueError if
    numbers that must be equal differ.
    """
    if a.shape[1] != b.shape[1]:
        raise ValueError(f"{a.shape[1]} worlds of one and {b.shape[1]} of the other: no pairs")
    if same_trainings and len(a) != len(b):
        raise ValueError(f"{len(a)} trainings of one and {len(b)} of the other: not the same")
    if same_trainings:
        return _interval(lambda *drawn: statistic(_select(a, *drawn), _select(b, *drawn)), *a.shape)
    return _interval(
        lambda of_a, of_b, worlds: statistic(_select(a, of_a, worlds), _select(b, of_b, worlds)),
        len(a), *b.shape,
    )  # fmt: skip


class Verdict(NamedTuple):
    """Whether method A is better than B over the same worlds.

    `difference` and `ratio` are of the means; `a_below_b` is the share of worlds where A's mean
    over its trainings is less, equal ones counting half. `better` is None if the interval of the
    difference contains 0, or there are too few worlds. `of_methods` is whether both have enough
    trainings for a claim about the methods; baselines need none.
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
    """Compare (S, K) with (T, K) over the same worlds; see `paired_bootstrap` for its errors."""

    def interval(statistic: Callable[[F64, F64], F64]) -> Interval95:
        return paired_bootstrap(a, b, statistic, same_trainings=same_trainings)

    difference = interval(difference_of_means)
    better: Literal["a", "b"] | None = None
    if a.shape[1] >= LEAST_WORLDS and difference.high < 0.0:
        better = "a"
    elif a.shape[1] >= LEAST_WORLDS and difference.low > 0.0:
        better = "b"
    return Verdict(
        better,
        difference,
        interval(ratio_of_means),
        interval(share_below),
        all(
            not trained or len(values) >= LEAST_TRAININGS
            for values, trained in ((a, trained_a), (b, trained_b))
        ),
    )


def what_would_tell(difference: Interval95, worlds: int) -> str:
    """Number of worlds that would show a difference where `worlds` do not, as text.

    `difference` is the verdict's; intervals shrink with the root of the number of worlds.
    """
    if worlds < LEAST_WORLDS:
        few = f"{worlds} worlds are" if worlds > 1 else "one world is"
        return f"{few} too few: at least {LEAST_WORLDS} are needed, often 50"
    value, low, high = difference
    width = max(high - value, value - low)
    if not abs(value) > 0.001 * width:
        return f"no difference is visible over {worlds} worlds"
    enough = max(worlds + 1, math.ceil(worlds * (width / abs(value)) ** 2))
    return f"{worlds} worlds are too few for this difference; about {enough} would show it"


def performance_profile(values: F64, thresholds: F64) -> F64:
    """Share of all values at or below each threshold (len(thresholds),); never falls."""
    ordered = np.sort(values, axis=None)
    return np.searchsorted(ordered, thresholds, side="right") / len(ordered)


def mean_over_time(time_s: F64, curves: F64) -> F64:
    """Time average (...,) of curves (..., T) at times (T,), ascending."""
    means: F64 = np.trapezoid(curves, time_s) / (time_s[-1] - time_s[0])
    return means


def at_most_share(of: int, failed: int) -> float:
    """Upper bound of the share of failures, at 95 % confidence, one-sided.

    Clopper and Pearson's bound; with no failures in n it is 1 - 0.05^(1/n), about 3 / n.
    """
    if of == 0:
        return 1.0
    test = scipy.stats.binomtest(failed, of, alternative="less")
    return float(test.proportion_ci(CONFIDENCE, method="exact").high)


def _select(values: F64, trainings: Any, worlds: Any) -> F64:
    """Select trainings (..., S) and worlds (..., K) of values (S', K'): (..., S, K)."""
    taken: F64 = values[trainings[..., :, None], worlds[..., None, :]]
    return taken


def _interval(statistic: Callable[..., F64], *counts: int) -> Interval95:
    """Bootstrap a statistic of indices: (..., n) for each of the `counts`, drawn independently.

    Draws with a NaN statistic are ignored; without other draws the interval is NaN.
    """
    whole = dict(enumerate(map(np.arange, counts)))
    # scipy does not resample a sample of one.
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
