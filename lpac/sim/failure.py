"""Robots that fail in flight."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from edge.core import Bools
from edge.core.schema import Bounded, NonNegative


@dataclass(frozen=True, slots=True)
class Failure(Bounded):
    """Absence of a robot from the swarm, from `from_s` until `until_s`; s since the start.

    A point stands still, neither receives nor sends, and does not count for the cost; it comes back
    like a restarted program, without map or messages. A whole robot is flown out of the fence and
    back by a pilot.

    Raises ValueError that names the invalid field.
    """

    robot: int
    from_s: NonNegative
    until_s: float = math.inf

    def check_rules(self) -> None:
        if not self.from_s < self.until_s:
            raise ValueError(
                f"failure of robot {self.robot}: until_s = {self.until_s}: must be after from_s = "
                f"{self.from_s}"
            )

    @classmethod
    def parse(cls, text: str) -> "Failure":
        """Parse "3@60-80": robot 3, from 60 to 80 s. Raises ValueError."""
        found = _AWAY.fullmatch(text)
        if found is None:
            raise ValueError(f"robot away {text!r}: must be ROBOT@FROM-UNTIL in s, such as 3@60-80")
        return cls(int(found[1]), float(found[2]), float(found[3]))


_SECONDS = r"(\d+\.?\d*)"
_AWAY = re.compile(rf"(\d+)@{_SECONDS}-{_SECONDS}")
_LOST = re.compile(rf"(\d+)@{_SECONDS}")


class LostRobots(NamedTuple):
    """Number of robots lost at a flight time, s; at 0 they are missing from the start."""

    robots: int
    at_s: float

    @classmethod
    def parse(cls, text: str) -> "LostRobots":
        """Parse "2@20". Raises ValueError."""
        found = _LOST.fullmatch(text)
        if found is None:
            raise ValueError(f"lost = {text!r}: must be ROBOTS@SECONDS, such as 2@20")
        return cls(int(found[1]), float(found[2]))

    def failures(self, of_robots: int) -> tuple[Failure, ...]:
        """Failures of the team's last robots; none if `at_s` is 0. Raises ValueError."""
        if self.at_s == 0.0:
            return ()
        if self.robots >= of_robots:
            raise ValueError(
                f"lost robots {self.robots}@{self.at_s:g}: must be fewer than the team's "
                f"{of_robots}"
            )
        lost = range(of_robots - self.robots, of_robots)
        return tuple(Failure(robot, self.at_s) for robot in lost)


NONE_LOST = LostRobots(0, 0.0)


def alive_at(robots: int, failures: Iterable[Failure], time_s: float) -> Bools:
    """(robots,): whether each robot is alive at that time."""
    alive = np.ones(robots, np.bool_)
    for failure in failures:
        if failure.from_s <= time_s < failure.until_s:
            alive[failure.robot] = False
    return alive


def require_possible(failures: Sequence[Failure], robots: int) -> None:
    """Raise ValueError for an unknown robot, overlapping failures of one, or no robot left."""
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
            raise ValueError(f"failures: no robot is left at {failure.from_s} s")
