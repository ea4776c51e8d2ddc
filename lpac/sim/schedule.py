"""One simulated clock, and what is due on it."""

import heapq
from collections.abc import Callable


class Schedule:
    """Runs what is due, in the order of time; of equal times, in the order of asking.

    It is a `Clock` itself: what runs sees its own time. The wall clock began at `epoch_s`, which
    may be set.
    """

    def __init__(self, epoch_s: float = 0.0) -> None:
        self.epoch_s = epoch_s
        self._now_s = 0.0
        self._due: list[tuple[float, int, Callable[[], object]]] = []
        self._asked = 0

    def monotonic_s(self) -> float:
        """Since the beginning."""
        return self._now_s

    def unix_s(self) -> float:
        """The wall clock."""
        return self.epoch_s + self._now_s

    def at(self, time_s: float, do: Callable[[], object]) -> None:
        """Do it then, or now if that is past."""
        self._asked += 1
        heapq.heappush(self._due, (max(time_s, self._now_s), self._asked, do))

    def every(
        self, period_s: float, do: Callable[[], object], after_s: float = 0.0
    ) -> "Recurrence":
        """Do it after that time, and then every period, on absolute deadlines."""
        recurrence = Recurrence(self, period_s, do, self._now_s + after_s)
        self.at(recurrence.due_s, recurrence)
        return recurrence

    def run_until(self, time_s: float) -> None:
        """Let that much time pass."""
        due = self._due
        while due and due[0][0] <= time_s:
            self._now_s, _, do = heapq.heappop(due)
            do()
        self._now_s = max(self._now_s, time_s)


class WallClock:
    """One computer's `Clock`: its wall clock is `ahead_s` ahead of the schedule's."""

    def __init__(self, schedule: Schedule) -> None:
        self.ahead_s = 0.0
        self._schedule = schedule

    def monotonic_s(self) -> float:
        """Since the beginning."""
        return self._schedule.monotonic_s()

    def unix_s(self) -> float:
        """Time on this computer's clock."""
        return self._schedule.unix_s() + self.ahead_s


class Recurrence:
    """Task that a schedule repeats, next at `due_s`."""

    def __init__(
        self, schedule: Schedule, period_s: float, do: Callable[[], object], due_s: float
    ) -> None:
        self.due_s = due_s
        self._schedule = schedule
        self._period_s = period_s
        self._do: Callable[[], object] | None = do
        self._hangs_until_s = due_s

    def __call__(self) -> None:
        """It is due."""
        if self._do is None:
            return
        self.due_s += self._period_s
        self._schedule.at(self.due_s, self)
        if self._schedule.monotonic_s() >= self._hangs_until_s:
            self._do()

    def hang(self, duration_s: float) -> None:
        """Leave out what is due within that time."""
        self._hangs_until_s = self._schedule.monotonic_s() + duration_s

    def stop(self) -> None:
        """Not once more."""
        self._do = None
