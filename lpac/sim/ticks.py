"""Tick times of the robots' loops."""

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from msgspec import Meta

from edge.core.schema import Bounded, Positive

Loop = Literal["perception", "policy", "control"]


@dataclass(frozen=True, slots=True)
class Clocks(Bounded):
    """Periods of a robot's three loops, s; a tick is early or late by up to `jitter` periods.

    With `synchronous` all loops start at once, without jitter.

    Raises ValueError that names the invalid field.
    """

    perception_s: Positive = 0.2
    policy_s: Positive = 0.4
    control_s: Positive = 0.1
    jitter: Annotated[float, Meta(ge=0.0, lt=0.5)] = 0.05
    synchronous: bool = False


class LoopTick(NamedTuple):
    """One tick of a robot's loop."""

    time_s: float
    loop: Loop
    robot: int


def ticks(robots: int, clocks: Clocks, rng: np.random.Generator) -> Iterator[LoopTick]:
    """All ticks of the robots in the order of time, without end, on absolute deadlines.

    `rng` draws the phases first, then the lateness of a robot's next tick after each tick. The
    flight has no influence on them.
    """
    # (time, order, due, period, tick); the order makes equal times deterministic.
    heap: list[tuple[float, int, float, float, Loop, int]] = []
    order = 0
    now_s = 0.0
    jitter = 0.0 if clocks.synchronous else clocks.jitter

    def upcoming(
        due_s: float, period_s: float, loop: Loop, robot: int
    ) -> tuple[float, int, float, float, Loop, int]:
        nonlocal order
        order += 1
        lateness_s = jitter * period_s * (2.0 * rng.random() - 1.0)
        return max(due_s + lateness_s, now_s), order, due_s, period_s, loop, robot

    periods_s: tuple[tuple[Loop, float], ...] = (
        ("perception", clocks.perception_s),
        ("policy", clocks.policy_s),
        ("control", clocks.control_s),
    )
    for robot in range(robots):
        for loop, period_s in periods_s:
            phase_s = 0.0 if clocks.synchronous else period_s * rng.random()
            heapq.heappush(heap, upcoming(phase_s, period_s, loop, robot))
    while True:
        now_s, _, due_s, period_s, loop, robot = heap[0]
        yield LoopTick(now_s, loop, robot)
        heapq.heapreplace(heap, upcoming(due_s + period_s, period_s, loop, robot))
