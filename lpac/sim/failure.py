"""Robots that fail in flight."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from edge.core import Bools


@dataclass(frozen=True, slots=True)
class Failure:
    """A robot is out of the swarm from `from_s` on until `until_s`; s since the start.

    It stands still, hears and says nothing, and does not count for the cost. It comes back as a
    restarted program does: with no explored map and no messages.

    Raises ValueError that names what is impossible.
    """

    robot: int
    from_s: float
    until_s: float = math.inf

    def __post_init__(self) -> None:
        if not 0.0 <= self.from_s < self.until_s:
            raise ValueError(
                f"failure of robot {self.robot}: from_s = {self.from_s}, until_s = {self.until_s}: "
                "must be at least 0, and until_s later"
            )


def alive_at(robots: int, failures: Iterable[Failure], time_s: float) -> Bools:
    """(robots,): who has not failed at that time."""
    alive = np.ones(robots, np.bool_)
    for failure in failures:
        if failure.from_s <= time_s < failure.until_s:
            alive[failure.robot] = False
    return alive


def require_possible(failures: Sequence[Failure], robots: int) -> None:
    """Raise ValueError if a robot of no swarm of so many fails, or one twice, or all at once."""
    for i, failure in enumerate(failures):
        if not 0 <= failure.robot < robots:
            raise ValueError(f"failures: robot {failure.robot}: must be from 0 to {robots - 1}")
        for other in (*failures[:i], *failures[i + 1 :]):
            if other.robot == failure.robot and other.from_s <= failure.from_s <= other.until_s:
                raise ValueError(
                    f"failures: robot {failure.robot} fails at {failure.from_s} s, when it has "
                    "failed already"
                )
        if not alive_at(robots, failures, failure.from_s).any():
            raise ValueError(f"failures: at {failure.from_s} s nobody is left")
