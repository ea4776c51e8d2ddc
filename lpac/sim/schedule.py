"""One simulated clock, and what is due on it."""

import heapq
from collections.abc import Callable


class Schedule:
    """Runs what is due, in the order of time; of equal times, in the order of asking.

    It is a `Clock` itself: what runs sees its own time. The wall clock began at `epoch_s`.
    """

    def __init__(self, epoch_s: float = 0.0) -> None:
        self._epoch_s = epoch_s
        self._now_s = 0.0
        self._due: list[tuple[float, int, Callable[[], object]]] = []
        self._asked = 0

    def monotonic_s(self) -> float:
        """Since the beginning."""
        return self._now_s

    def unix_s(self) -> float:
        """The wall clock."""
        return self._epoch_s + self._now_s

    def at(self, time_s: float, do: Callable[[], object]) -> None:
        """Do it then, or now if that is past."""
        self._asked += 1
        heapq.heappush(self._due, (max(time_s, self._now_s), self._asked, do))

    def every(self, period_s: float, do: Callable[[], object], first_s: float = 0.0) -> None:
        """Do it at `first_s`, and then every period, on absolute deadlines."""

        def again() -> None:
            nonlocal first_s
            first_s += period_s
            self.at(first_s, again)
            do()

        self.at(first_s, again)

    def run_until(self, time_s: float) -> None:
        """Let that much time pass."""
        while self._due and self._due[0][0] <= time_s:
            self._now_s, _, do = heapq.heappop(self._due)
            do()
        self._now_s = max(self._now_s, time_s)
