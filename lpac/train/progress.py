"""Progress and remaining time of a run."""

import time
from collections import defaultdict
from collections.abc import Callable
from typing import Literal, NamedTuple

Stage = Literal["generate", "fit", "select", "export"]


class RunProgress(NamedTuple):
    """Present stage of a run.

    `done` is the share of the whole run; `loss` is that of the newest epoch, `cost` the least mean
    closed-loop cost of a candidate. `left_s` is None while it is unknown.
    """

    stage: Stage
    round: int
    done: float
    loss: float | None
    cost: float | None
    left_s: float | None


class Work:
    """Counts the work done, in units of each stage, and times it."""

    def __init__(
        self,
        planned: dict[Stage, float],
        report: Callable[[RunProgress], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`planned` are the units of each stage in all rounds, which differ between stages."""
        self._planned = planned
        self._report = report
        self._clock = clock
        self._done: dict[Stage, float] = defaultdict(float)
        # Done by this process, without earlier work.
        self._timed: dict[Stage, float] = defaultdict(float)
        self._seconds: dict[Stage, float] = defaultdict(float)
        self._since: float = clock()
        self.loss: float | None = None
        self.cost: float | None = None

    def skip(self, stage: Stage, units: float) -> None:
        """Count units that were done before."""
        self._done[stage] += units

    def begin(self) -> None:
        """Start timing."""
        self._since = self._clock()

    def add(self, stage: Stage, round_: int, units: float) -> None:
        """Count units that were done since the last call, and report progress."""
        now = self._clock()
        self._seconds[stage] += now - self._since
        self._since = now
        self._done[stage] += units
        self._timed[stage] += units
        self.show(stage, round_)

    def show(self, stage: Stage, round_: int) -> None:
        """Report progress."""
        left = {
            each: max(planned - self._done[each], 0.0) for each, planned in self._planned.items()
        }
        rates = {
            each: seconds / self._timed[each]
            for each, seconds in self._seconds.items()
            if self._timed[each] > 0
        }
        known = all(each in rates for each, units in left.items() if units > 0)
        shares = [
            1.0 - left[each] / planned for each, planned in self._planned.items() if planned > 0
        ]
        self._report(
            RunProgress(
                stage,
                round_,
                sum(shares) / len(shares),
                self.loss,
                self.cost,
                sum(units * rates[each] for each, units in left.items() if units > 0)
                if known
                else None,
            )
        )
