"""Cumulative counts of the messages received from another robot, by age.

The difference between two counts covers the time in between.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

# Upper edges of the age bins. Robots discard messages after 0.8 s; the first edge is the clocks'
# uncertainty on a good radio.
AGE_EDGES_S = (0.025, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
_BINS = len(AGE_EDGES_S) + 1


class Arrivals(NamedTuple):
    """Messages of one robot received by another.

    `sent` counts the messages sent from the first to the newest received one, by sequence number.
    `undated` counts messages of unknown age, `by_age` (9,) those with ages in the bins of
    `AGE_EDGES_S`.
    """

    sent: int = 0
    undated: int = 0
    by_age: tuple[int, ...] = (0,) * _BINS

    @classmethod
    def of_counts(cls, counts: Sequence[int]) -> "Arrivals":
        """Inverse of `counts`; bins beyond those here are merged into the last."""
        sent, undated, *by_age = (*counts, *(0,) * (2 + _BINS))
        return cls(sent, undated, (*by_age[: _BINS - 1], sum(by_age[_BINS - 1 :])))

    @property
    def counts(self) -> tuple[int, ...]:
        """`sent`, `undated` and `by_age` without trailing zeros, for messages."""
        numbers = [self.sent, self.undated, *self.by_age]
        while numbers and not numbers[-1]:
            numbers.pop()
        return tuple(numbers)

    @property
    def arrived(self) -> int:
        """Number of received messages."""
        return self.undated + sum(self.by_age)

    def since(self, before: "Arrivals") -> "Arrivals":
        """Counts since `before`, an earlier count of the same receiver."""
        by_age = zip(self.by_age, before.by_age, strict=True)
        return Arrivals(
            self.sent - before.sent, self.undated - before.undated, tuple(a - b for a, b in by_age)
        )

    def plus(self, sent: int, age_s: float | None) -> "Arrivals":
        """Add one received message of this age (None: unknown), and `sent` sent ones."""
        if age_s is None:
            return self._replace(sent=self.sent + sent, undated=self.undated + 1)
        at, by_age = bisect_right(AGE_EDGES_S, age_s), list(self.by_age)
        by_age[at] += 1
        return Arrivals(self.sent + sent, self.undated, tuple(by_age))

    def older_than(self, edge_s: float) -> int:
        """Number of messages of at least the age `edge_s`, one of `AGE_EDGES_S`."""
        return sum(self.by_age[AGE_EDGES_S.index(edge_s) + 1 :])

    def age_s(self, share: float) -> float | None:
        """Quantile of the ages for `share` (0 to 1); None without ages.

        Ages are interpolated within a bin. Beyond the last edge the result is that edge.
        """
        upto = list(accumulate(self.by_age))
        if upto[-1] <= 0:
            return None
        rank = share * upto[-1]
        at = bisect_left(upto, max(rank, 1e-9))
        if at == len(AGE_EDGES_S):
            return AGE_EDGES_S[-1]
        below_s = AGE_EDGES_S[at - 1] if at else 0.0
        inside = (rank - (upto[at] - self.by_age[at])) / self.by_age[at]
        return below_s + inside * (AGE_EDGES_S[at] - below_s)
