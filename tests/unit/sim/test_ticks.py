"""The clocks of a swarm's robots."""

from itertools import pairwise, takewhile
from typing import Any

import numpy as np
import pytest

from lpac.sim.ticks import Clocks, ticks


def test_each_loop_ticks_at_its_rate_in_the_order_of_time() -> None:
    clocks = Clocks(perception_s=0.2, policy_s=0.4, control_s=0.1, jitter=0.05)
    drawn = list(takewhile(lambda t: t.time_s < 20.0, ticks(3, clocks, np.random.default_rng(1))))
    assert all(one.time_s <= other.time_s for one, other in pairwise(drawn))
    for robot in range(3):
        for loop, period_s in (("perception", 0.2), ("policy", 0.4), ("control", 0.1)):
            times_s = [t.time_s for t in drawn if (t.robot, t.loop) == (robot, loop)]
            assert len(times_s) == pytest.approx(20.0 / period_s, abs=1.0)
            assert np.abs(np.diff(times_s) / period_s - 1.0).max() <= 0.1 + 1e-9


def test_synchronous_robots_tick_at_the_same_moments() -> None:
    clocks = Clocks(perception_s=0.2, policy_s=0.4, synchronous=True)
    drawn = takewhile(lambda t: t.time_s < 20.0, ticks(3, clocks, np.random.default_rng(1)))
    times_s: dict[tuple[int, str], list[float]] = {}
    for tick in drawn:
        times_s.setdefault((tick.robot, tick.loop), []).append(tick.time_s)
    for loop, period_s in (("perception", 0.2), ("policy", 0.4), ("control", 0.1)):
        first, *others = (times_s[robot, loop] for robot in range(3))
        assert all(other == first for other in others)
        np.testing.assert_allclose(first, period_s * np.arange(len(first)), atol=1e-9)


@pytest.mark.parametrize(
    ("change", "text"),
    [({"policy_s": 0.0}, "policy_s = 0.0: must be above 0"), ({"jitter": 0.5}, "jitter = 0.5")],
)
def test_impossible_clocks_are_named(change: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        Clocks(**change)
