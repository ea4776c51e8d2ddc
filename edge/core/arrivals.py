"""How many of another robot's messages arrived, and how old they were: counts that only grow.

Whoever listens takes the difference of two of them, over whatever time he likes.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

# Where an age's bin ends and the next one begins. 0.8 s is when messages are forgotten; the first
# is as much as robots do not know of each other's clocks on a good radio.
AGE_EDGES_S = (0.025, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
_BINS = len(AGE_EDGES_S) + 1


class Arrivals(NamedTuple):
    """Of what one robot says, what came to another.

    `sent` is how many messages it said, by their sequence, from the first that came to the newest
    that did. `undated` came at an age that is not known, `by_age` (9,) at ages in the bins between
    `AGE_EDGES_S`.
    """

    sent: int = 0
    undated: int = 0
    by_age: tuple[int, ...] = (0,) * _BINS

    @classmethod
    def of_counts(cls, counts: Sequence[int]) -> "Arrivals":
        """The inverse of `counts`; more bins than there are here are one."""
        sent, undated, *by_age = (*counts, *(0,) * (2 + _BINS))
        return cls(sent, undated, (*by_age[: _BINS - 1], sum(by_age[_BINS - 1 :])))

    @property
    def counts(self) -> tuple[int, ...]:
        """`sent`, `undated` and `by_age`, but for zeros at the end: short, for messages."""
        numbers = [self.sent, self.undated, *self.by_age]
        while numbers and not numbers[-1]:
            numbers.pop()
        return tuple(numbers)

    @property
    def arrived(self) -> int:
        """How many came."""
        return self.undated + sum(self.by_age)

    def since(self, before: "Arrivals") -> "Arrivals":
        """Counts since `before`, an earlier count of the same receiver."""
        by_age = zip(self.by_age, before.by_age, strict=True)
        return Arrivals(
            self.sent - before.sent, self.undated - before.undated, tuple(a - b for a, b in by_age)
        )

    def plus(self, sent: int, age_s: float | None) -> "Arrivals":
        """With one that came so old, and `sent` more that were said."""
        if age_s is None:
            return self._replace(sent=self.sent + sent, undated=self.undated + 1)
        at, by_age = bisect_right(AGE_EDGES_S, age_s), list(self.by_age)
        by_age[at] += 1
        return Arrivals(self.sent + sent, self.undated, tuple(by_age))

    def older_than(self, edge_s: float) -> int:
        """How many came as old as one of `AGE_EDGES_S`, or older."""
        return sum(self.by_age[AGE_EDGES_S.index(edge_s) + 1 :])

    def age_s(self, share: float) -> float | None:
        """The age that this share (0 to 1) of those with an age came within; None if none did.

        Within a bin ages are taken to be spread evenly; of those past the last edge only that is
        known, and it is told.
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
