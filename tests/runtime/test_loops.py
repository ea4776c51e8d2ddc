"""Loops on absolute deadlines: they tick, survive failures, and count what went wrong."""

import threading
import time

from edge.runtime.loops import Loop


def run_until(loop: Loop, done: threading.Event) -> None:
    loop.start()
    try:
        assert done.wait(20.0)
    finally:
        assert loop.stop(5.0)


def test_deadlines_are_absolute() -> None:
    """Work within a tick does not push the next one back: no tick is ever early or lost."""
    period_s, began_s = 0.02, []
    done = threading.Event()

    def step() -> None:
        began_s.append(time.monotonic())
        if len(began_s) == 50:
            done.set()
        time.sleep(period_s / 4)

    loop = Loop("test", period_s, step)
    run_until(loop, done)
    status = loop.status()
    passed = len(began_s) - 1 + status.overruns
    # With relative waits each tick would add at least the work's time.
    lateness_s = began_s[-1] - began_s[0] - passed * period_s
    assert -1e-3 < lateness_s < passed * period_s / 4
    assert status.ticks == len(began_s)
    assert 0.0 <= status.lateness_p50_ms <= status.lateness_p99_ms <= status.lateness_max_ms


def test_a_long_tick_leaves_deadlines_out_instead_of_running_twice() -> None:
    began_s: list[float] = []
    done = threading.Event()

    def step() -> None:
        began_s.append(time.monotonic())
        if len(began_s) == 2:
            time.sleep(0.35)
        if len(began_s) == 4:
            done.set()

    loop = Loop("test", 0.1, step)
    run_until(loop, done)
    assert loop.status().overruns >= 2
    # The tick after the long one comes on a deadline, not at once after it.
    assert began_s[2] - began_s[1] > 0.37


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
    run_until(loop, done)
    assert loop.status().failures == loop.status().ticks >= 6


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
