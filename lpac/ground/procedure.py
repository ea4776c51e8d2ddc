"""Procedures of several commands, with waits in between, as steps that somebody else times.

A procedure is a generator. It yields what it wants: a `Request` for the ground, answered by its
`CommandReport`, or `Until`, answered by whether that came true in time. Whoever has the ground
carries it out: over the ground's socket (`station.subscriber`), or in the simulator on its clock.
"""

from collections.abc import Callable, Collection, Generator
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from edge.messages.mission import RobotStatus
from lpac.analysis.snapshot import FRESH_S, FleetSetup, FleetSnapshot
from lpac.ground.station.protocol import Request

_PATIENCE_S = 5.0

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Until:
    """Wait until `condition` holds of a snapshot, for `at_most_s`."""

    condition: Callable[[FleetSnapshot], bool]
    at_most_s: float


Procedure = Generator[Request | Until, Any, T]


class Ground(Protocol):
    """A procedure's view of the ground, as it was told last."""

    @property
    def setup(self) -> FleetSetup:
        """The fleet's setup, which seldom changes."""
        ...

    @property
    def snapshot(self) -> FleetSnapshot:
        """The fleet as it was told last."""
        ...

    @property
    def now_s(self) -> float:
        """A monotonic clock, s."""
        ...

    @property
    def unix_now_s(self) -> float:
        """The wall clock, s."""
        ...


class NothingComesError(RuntimeError):
    """The ground tells nothing any more."""


def carry_out(
    procedure: Procedure[T], command: Callable[[Request], object], wait: Callable[[Until], bool]
) -> T:
    """Answer a procedure until it is through, and return its result. Raises what it raises."""
    answer: object = None
    while True:
        try:
            wanted = procedure.send(answer)
        except StopIteration as done:
            result: T = done.value
            return result
        answer = wait(wanted) if isinstance(wanted, Until) else command(wanted)


def fresh_snapshot(ground: Ground) -> Procedure[FleetSnapshot]:
    """The fleet as it is told from now on. Raises NothingComesError."""
    asked_unix_s = ground.unix_now_s
    if not (yield Until(lambda told: told.unix_time_s >= asked_unix_s, _PATIENCE_S)):
        raise NothingComesError("the ground tells nothing any more")
    return ground.snapshot


def gather(
    ground: Ground, robots: Collection[str], duration_s: float
) -> Procedure[dict[str, list[RobotStatus]]]:
    """Collect the statuses of these robots from now on, each once.

    For `duration_s`, and `FRESH_S` more for one of which nothing came; [] if that is silent.
    """
    heard: dict[str, dict[tuple[int, int], RobotStatus]] = {robot: {} for robot in robots}
    began_s = ground.now_s

    def take(snapshot: FleetSnapshot) -> bool:
        passed_s = ground.now_s - began_s
        for robot in snapshot.robots:
            status, age_s = robot.status, robot.age_s
            if robot.name in heard and status and age_s is not None and age_s <= passed_s:
                heard[robot.name][status.boot_nonce, status.sequence] = status
        return passed_s >= duration_s and all(heard.values())

    yield Until(take, duration_s + FRESH_S)
    return {robot: list(statuses.values()) for robot, statuses in heard.items()}
