"""Threads that run steps on absolute deadlines, with statistics of their lateness.

A late loop skips the deadlines that have passed. A step that raises is logged and counted, and the
loop continues: users of its results see them grow old.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence

from edge.core.logger import log
from edge.messages.mission import LoopStatus

_LATENESSES_KEPT_S = 60.0


class Loop:
    """Calls `step` every `period_s` in a thread of its own, from `start` to `stop`."""

    def __init__(self, name: str, period_s: float, step: Callable[[], None]) -> None:
        self.name = name
        self._period_s = period_s
        self._step = step
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        # Written by the loop's thread alone.
        self._ticks = self._overruns = self._failures = 0
        self._latenesses_s: deque[float] = deque(maxlen=math.ceil(_LATENESSES_KEPT_S / period_s))
        self._succeeded_s: float | None = None

    def start(self) -> int:
        """Start the thread, with a tick at once. Returns the thread's native id."""
        self._thread.start()
        assert self._thread.native_id is not None
        return self._thread.native_id

    def stop(self, timeout_s: float) -> bool:
        """End the loop after the present tick. Returns whether it ended within `timeout_s`."""
        self._stop.set()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def status(self) -> LoopStatus:
        """Counts since the start, and the lateness over the last minute. Thread-safe."""
        latenesses_ms = sorted(1e3 * late_s for late_s in self._latenesses_s.copy()) or [0.0]
        return LoopStatus(
            ticks=self._ticks,
            overruns=self._overruns,
            failures=self._failures,
            lateness_p50_ms=_percentile(latenesses_ms, 0.5),
            lateness_p99_ms=_percentile(latenesses_ms, 0.99),
            lateness_max_ms=latenesses_ms[-1],
        )

    def age_s(self) -> float | None:
        """Time since the last successful tick, s; None before the first. Thread-safe."""
        succeeded_s = self._succeeded_s
        return None if succeeded_s is None else time.monotonic() - succeeded_s

    def _run(self) -> None:
        deadline_s = time.monotonic()
        while not self._stop.is_set():
            late_s = time.monotonic() - deadline_s
            self._latenesses_s.append(late_s)
            self._tick()
            deadline_s += self._period_s
            passed = math.ceil((time.monotonic() - deadline_s) / self._period_s)
            if passed > 0:
                self._overruns += passed
                deadline_s += passed * self._period_s
            self._stop.wait(max(0.0, deadline_s - time.monotonic()))

    def _tick(self) -> None:
        self._ticks += 1
        try:
            self._step()
            self._succeeded_s = time.monotonic()
        except Exception as error:
            self._failures += 1
            if self._stop.is_set():
                return  # The program ends, and has closed what the step waited for.
            # Ever more rarely, so that repeated failures cannot fill the disk.
            if self._failures & (self._failures - 1) == 0:
                log.error(
                    "loop step failed", exc_info=error, loop=self.name, failures=self._failures
                )


def _percentile(ascending: Sequence[float], share: float) -> float:
    return ascending[min(len(ascending) - 1, int(share * len(ascending)))]
