"""Simulated clock with scheduled callbacks."""

import heapq
from collections.abc import Callable


class Schedule:
    """Run callbacks in the order of time; those of equal times in the order of scheduling.

    It is also a `Clock`, on which each callback sees its own time. The wall clock starts at
    `epoch_s`, which may be set.
    """

    def __init__(self, epoch_s: float = 0.0) -> None:
        self.epoch_s = epoch_s
        self._now_s = 0.0
        self._due: list[tuple[float, int, Callable[[], object]]] = []
        self._count = 0

    def monotonic_s(self) -> float:
        """Time since the start, s."""
        return self._now_s

    def unix_s(self) -> float:
        """Unix time, s."""
        return self.epoch_s + self._now_s

    def at(self, time_s: float, callback: Callable[[], object]) -> None:
        """Schedule a callback; a time in the past means now."""
        self._count += 1
        heapq.heappush(self._due, (max(time_s, self._now_s), self._count, callback))

    def every(
        self, period_s: float, callback: Callable[[], object], after_s: float = 0.0
    ) -> "Timer":
        """Schedule a callback after `after_s` and then every period, on absolute deadlines."""
        timer = Timer(self, period_s, callback, self._now_s + after_s)
        self.at(timer.due_s, timer)
        return timer

    def run_until(self, time_s: float) -> None:
        """Run all callbacks due until `time_s`, and advance the clock to it."""
        due = self._due
        while due and due[0][0] <= time_s:
            self._now_s, _, callback = heapq.heappop(due)
            callback()
        self._now_s = max(self._now_s, time_s)


class WallClock:
    """One computer's `Clock`: its wall clock is `ahead_s` ahead of the schedule's."""

    def __init__(self, schedule: Schedule) -> None:
        self.ahead_s = 0.0
        self._schedule = schedule

    def monotonic_s(self) -> float:
        """Time since the schedule's start, s."""
        return self._schedule.monotonic_s()

    def unix_s(self) -> float:
        """Unix time of this computer."""
        return self._schedule.unix_s() + self.ahead_s


class Timer:
    """Periodic callback of a schedule, next at `due_s`."""

    def __init__(
        self, schedule: Schedule, period_s: float, callback: Callable[[], object], due_s: float
    ) -> None:
        self.due_s = due_s
        self._schedule = schedule
        self._period_s = period_s
        self._callback: Callable[[], object] | None = callback
        self._hangs_until_s = due_s

    def __call__(self) -> None:
        """Run the callback and schedule the next."""
        if self._callback is None:
            return
        self.due_s += self._period_s
        self._schedule.at(self.due_s, self)
        if self._schedule.monotonic_s() >= self._hangs_until_s:
            self._callback()

    def hang(self, duration_s: float) -> None:
        """Skip the callbacks due within that time."""
        self._hangs_until_s = self._schedule.monotonic_s() + duration_s

    def stop(self) -> None:
        """Cancel all further callbacks."""
        self._callback = None
