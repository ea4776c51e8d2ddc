"""Progress and remaining time."""

import pytest

from lpac.train.progress import RunProgress, Work


def test_time_left_is_known_once_each_stage_was_seen() -> None:
    told: list[RunProgress] = []
    now = 0.0
    work = Work({"generate": 10.0, "fit": 100.0, "select": 4.0}, told.append, lambda: now)
    work.skip("generate", 5.0)
    work.begin()
    now = 10.0
    work.add("generate", 0, 5.0)
    assert told[-1].left_s is None and told[-1].done == pytest.approx(1.0 / 3.0)
    work.loss = 0.5
    now = 30.0
    work.add("fit", 0, 50.0)
    # Time outside of begin() and add() does not count, such as waiting.
    now = 1000.0
    work.begin()
    now = 1001.0
    work.add("select", 0, 1.0)
    # 50 units of 0.4 s, and three of 1 s.
    assert told[-1].left_s == pytest.approx(23.0)
    assert (told[-1].stage, told[-1].loss, told[-1].cost) == ("select", 0.5, None)
    now = 1002.0
    work.add("select", 0, 3.0)
    work.add("fit", 0, 50.0)
    assert told[-1].done == pytest.approx(1.0) and told[-1].left_s == pytest.approx(0.0)
