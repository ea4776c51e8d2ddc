"""Procedures: sequences of commands and waits, independent of a clock.

A procedure is a generator. It yields a `Request`, answered by its `CommandReport`, or an `Until`,
answered by whether that came true in time. It is run over the ground's socket
(`station.subscriber`), or in the simulator on the simulated clock.
"""

from collections.abc import Callable, Collection, Generator
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from edge.messages.mission import RobotStatus
from lpac.analysis.snapshot import FRESH_S, FleetSetup, FleetSnapshot
from lpac.ground.station.protocol import Request

_TIMEOUT_S = 5.0

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Until:
    """Wait until a snapshot meets `condition`, for at most `at_most_s`."""

    condition: Callable[[FleetSnapshot], bool]
    at_most_s: float


Procedure = Generator[Request | Until, Any, T]


class Ground(Protocol):
    """A procedure's view of the ground."""

    @property
    def setup(self) -> FleetSetup:
        """The newest setup."""
        ...

    @property
    def snapshot(self) -> FleetSnapshot:
        """The newest snapshot."""
        ...

    @property
    def now_s(self) -> float:
        """Monotonic time, s."""
        ...

    @property
    def unix_now_s(self) -> float:
        """Wall clock, Unix time, s."""
        ...


class NoSnapshotError(RuntimeError):
    """The ground sends no snapshots any more."""


def carry_out(
    procedure: Procedure[T], command: Callable[[Request], object], wait: Callable[[Until], bool]
) -> T:
    """Run a procedure and return its result. Raises what it raises."""
    answer: object = None
    while True:
        try:
            wanted = procedure.send(answer)
        except StopIteration as done:
            result: T = done.value
            return result
        answer = wait(wanted) if isinstance(wanted, Until) else command(wanted)


def fresh_snapshot(ground: Ground) -> Procedure[FleetSnapshot]:
    """Wait for a snapshot that is made from now on. Raises NoSnapshotError."""
    now_unix_s = ground.unix_now_s
    if not (yield Until(lambda snapshot: snapshot.unix_time_s >= now_unix_s, _TIMEOUT_S)):
        raise NoSnapshotError("the ground sends no snapshots any more")
    return ground.snapshot


def collect_statuses(
    ground: Ground, robots: Collection[str], duration_s: float
) -> Procedure[dict[str, list[RobotStatus]]]:
    """Collect the new statuses of these robots for `duration_s`.

    Waits `FRESH_S` longer for a robot without any; [] if it stays silent.
    """
    found: dict[str, dict[tuple[int, int], RobotStatus]] = {robot: {} for robot in robots}
    began_s = ground.now_s

    def take(snapshot: FleetSnapshot) -> bool:
        passed_s = ground.now_s - began_s
        for robot in snapshot.robots:
            status, age_s = robot.status, robot.age_s
            if robot.name in found and status and age_s is not None and age_s <= passed_s:
                found[robot.name][status.boot_nonce, status.sequence] = status
        return passed_s >= duration_s and all(found.values())

    yield Until(take, duration_s + FRESH_S)
    return {robot: list(statuses.values()) for robot, statuses in found.items()}
