"""Loops on absolute deadlines: they tick, survive failures, and count what went wrong."""

import threading
from types import SimpleNamespace

import pytest

from edge.robot.loops import Loop
from tests.said import lines_said


def run_until(loop: Loop, done: threading.Event) -> None:
    loop.start()
    try:
        assert done.wait(60.0)
    finally:
        assert loop.stop(60.0)


class Clock(threading.Event):
    """Time that passes while a loop waits for its stop, which this is, and when a step says so."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        self.now_s += timeout
        return self.is_set()


def ticks_of(
    period_s: float, works_s: list[float], monkeypatch: pytest.MonkeyPatch
) -> tuple[list[float], Loop]:
    """When each tick began, after the first, if they take so long; and the loop that ended."""
    clock, began_s = Clock(), list[float]()

    def step() -> None:
        began_s.append(clock.now_s - 100.0)
        clock.now_s += works_s[len(began_s) - 1]
        if len(began_s) == len(works_s):
            clock.set()

    loop = Loop("test", period_s, step)
    loop._stop = clock
    monkeypatch.setattr("edge.robot.loops.time", SimpleNamespace(monotonic=clock.monotonic))
    loop._run()
    return began_s, loop


def test_deadlines_are_absolute(monkeypatch: pytest.MonkeyPatch) -> None:
    """Work within a tick does not push the next one back: no tick is ever early or lost."""
    began_s, loop = ticks_of(0.02, [0.005] * 50, monkeypatch)
    assert began_s == pytest.approx([0.02 * tick for tick in range(50)])
    status = loop.status()
    assert (status.ticks, status.overruns) == (50, 0)
    lateness_ms = status.lateness_p50_ms, status.lateness_p99_ms, status.lateness_max_ms
    assert lateness_ms == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    assert loop.age_s() == pytest.approx(0.015)


def test_lateness_is_that_of_the_last_minute() -> None:
    loop = Loop("test", 0.5, lambda: None)
    loop._latenesses_s.extend(tick / 1e3 for tick in range(200))
    status = loop.status()
    lateness_ms = status.lateness_p50_ms, status.lateness_p99_ms, status.lateness_max_ms
    assert lateness_ms == pytest.approx((140.0, 198.0, 199.0))


def test_a_long_tick_leaves_deadlines_out_instead_of_running_twice(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    began_s, loop = ticks_of(0.1, [0.0, 0.35, 0.0, 0.0], monkeypatch)
    # The tick after the long one comes on a deadline, not at once after it.
    assert began_s == pytest.approx([0.0, 0.1, 0.5, 0.6])
    assert loop.status().overruns == 3


def test_a_step_that_raises_is_counted_and_the_loop_goes_on() -> None:
    done = threading.Event()
    ticks = 0

    def step() -> None:
        nonlocal ticks
        ticks += 1
        if ticks > 5:
            done.set()
        raise RuntimeError("broken")

    loop = Loop("test", 0.01, step)
    with lines_said() as lines:
        run_until(loop, done)
    failures = loop.status().failures
    assert failures == loop.status().ticks >= 6 and loop.age_s() is None
    # A log that fills the disk helps nobody: of the first, the second, the fourth and so on.
    logged = [line["failures"] for line in lines]
    assert logged == [2**n for n in range(len(logged))] and 4 in logged


def test_a_loop_that_hangs_does_not_hold_up_its_stop() -> None:
    began, release = threading.Event(), threading.Event()

    def step() -> None:
        began.set()
        release.wait()

    loop = Loop("test", 0.01, step)
    loop.start()
    assert began.wait(20.0)
    assert not loop.stop(0.05)
    release.set()
    assert loop.stop(20.0)


def test_what_fails_because_the_program_ends_is_no_defect() -> None:
    began, closed = threading.Event(), threading.Event()

    def step() -> None:
        began.set()
        closed.wait()
        raise RuntimeError("closed")

    loop = Loop("test", 0.01, step)
    with lines_said() as lines:
        loop.start()
        assert began.wait(20.0)
        assert not loop.stop(0.05)
        closed.set()
        assert loop.stop(20.0)
    assert not lines and loop.status().failures == 1
