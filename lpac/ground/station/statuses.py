"""Robots' statuses, as a ground station receives them.

Pure: the owner sets the time. A program is known by its robot's id and its boot nonce.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from edge.core.arrivals import Arrivals
from edge.messages.mission import RadioCounts, RobotStatus
from lpac.analysis.snapshot import FRESH_S, RobotSnapshot
from lpac.ground.rendering import state_and_reason

# Longest gap between two statuses of a running program, with one status lost.
_STATUS_GAP_S = 1.2
_RATE_WINDOW_S = 3.0
# Long enough to estimate the share of messages that arrive.
_ARRIVALS_WINDOW_S = 10.0

TWO_PROGRAMS = "two programs have this robot's id"

# As `Station.notify`.
Notify = Callable[..., None]


class _Received(NamedTuple):
    at_s: float
    clock_ahead_s: float
    status: RobotStatus


@dataclass(slots=True)
class _ProgramStart:
    """One start of a robot's program, and its statuses of the last few seconds."""

    first_s: float
    received: deque[_Received] = field(default_factory=deque)
    # Of the other robots' messages, within the window.
    arrivals: dict[str, tuple[int, ...]] = field(default_factory=dict)

    @property
    def newest(self) -> _Received:
        return self.received[-1]

    def add(self, new: _Received) -> bool:
        """Add a status; False if it is not newer than the last."""
        if self.received and new.status.sequence <= self.newest.status.sequence:
            return False
        self.received.append(new)
        changed = [new]
        while new.at_s - self.received[0].at_s > _ARRIVALS_WINDOW_S:
            changed.append(self.received.popleft())
        if any(r.status.radio_counts is not None for r in changed):
            counts = [r.status.radio_counts for r in self.received]
            self.arrivals = _arrivals([each for each in counts if each is not None])
        return True


class _Robot:
    """One robot. Of two programs, the first counts until it falls silent."""

    def __init__(self, name: str, robot_id: int) -> None:
        self.name = name
        self.robot_id = robot_id
        self.present = False
        self.duplicate = False
        self.other_release = ""
        self._programs: dict[int, _ProgramStart] = {}
        self._nonce: int | None = None

    @property
    def program(self) -> _ProgramStart | None:
        return None if self._nonce is None else self._programs[self._nonce]

    def fresh(self, now_s: float) -> RobotStatus | None:
        program = self.program
        if program is None or now_s - program.newest.at_s > FRESH_S:
            return None
        return program.newest.status

    def add(self, new: _Received) -> bool:
        """Add a status; False unless it is a newer one of the program that counts."""
        nonce = new.status.boot_nonce
        if not self._programs.setdefault(nonce, _ProgramStart(new.at_s)).add(new):
            return False
        program = self.program
        if program is None or new.at_s - program.newest.at_s > _STATUS_GAP_S:
            self._nonce = nonce
        self._programs = {
            n: p
            for n, p in self._programs.items()
            if n == self._nonce or new.at_s - p.newest.at_s <= FRESH_S
        }
        return nonce == self._nonce

    def has_two_programs(self, now_s: float) -> bool:
        """Whether statuses of two programs interleave. After a restart they do not."""
        alive = [p for p in self._programs.values() if now_s - p.newest.at_s <= FRESH_S]
        return len(alive) > 1 and max(p.first_s for p in alive) < min(p.newest.at_s for p in alive)

    def others(self, now_s: float) -> list[tuple[RobotStatus, float]]:
        newest = (p.newest for nonce, p in self._programs.items() if nonce != self._nonce)
        return [(r.status, now_s - r.at_s) for r in newest if now_s - r.at_s <= FRESH_S]

    def snapshot(self, now_s: float) -> RobotSnapshot:
        program = self.program
        if program is None:
            return RobotSnapshot(self.name, self.robot_id)
        at_s, _, newest = program.newest
        recent = [r for r in program.received if at_s - r.at_s <= _RATE_WINDOW_S]
        return RobotSnapshot(
            name=self.name,
            robot_id=self.robot_id,
            status=newest,
            age_s=now_s - at_s,
            # The least delayed status has the best estimate: delay makes a clock look slow.
            clock_offset_s=max(received.clock_ahead_s for received in recent),
            rates_hz=_rates_hz(recent[0].status, newest),
            arrivals=program.arrivals,
            duplicate=self.duplicate,
            other_release=self.other_release,
        )


class RobotStatuses:
    """Statuses of the fleet's robots, by robot id. `robots` maps names to ids."""

    def __init__(
        self, robots: Mapping[str, int], now_s: float, unix_now_s: float, notify: Notify
    ) -> None:
        self.names = {robot_id: name for name, robot_id in robots.items()}
        self.now_s, self.unix_now_s = now_s, unix_now_s
        self._began_s = now_s
        self._robots = {id_: _Robot(name, id_) for id_, name in self.names.items()}
        # Ids of robots whose key signs for two programs, even if only one is received.
        self.duplicate_keys: frozenset[int] = frozenset()
        self._notify = notify

    @property
    def age_s(self) -> float:
        """Time since this was made, s."""
        return self.now_s - self._began_s

    def receive(self, status: RobotStatus, other_release: str = "") -> bool:
        """Add a status. False if it is not newer, of an unknown robot, or of a second program."""
        robot = self._robots.get(status.robot_id)
        if robot is None:
            return False
        before = None if robot.program is None else robot.program.newest.status
        if not robot.add(_Received(self.now_s, status.unix_time_s - self.unix_now_s, status)):
            return False
        robot.other_release = other_release
        if before is not None and before.boot_nonce != status.boot_nonce:
            self._notify("presence", robot.name, "its program has restarted")
        if before is None or (before.state, before.reason) != (status.state, status.reason):
            self._notify("state", robot.name, state_and_reason(status))
        self._update(robot)
        return True

    def update(self) -> None:
        """Notify of robots that fell silent or have two programs. Call periodically."""
        for robot in self._robots.values():
            self._update(robot)

    def _update(self, robot: _Robot) -> None:
        present = robot.fresh(self.now_s) is not None
        if present != robot.present:
            robot.present = present
            text = "heard" if present else f"silent for {FRESH_S:g} s"
            self._notify("presence", robot.name, text)
        duplicate = robot.has_two_programs(self.now_s) or robot.robot_id in self.duplicate_keys
        if duplicate and not robot.duplicate:
            self._notify("presence", robot.name, TWO_PROGRAMS)
        robot.duplicate = duplicate

    def status(self, robot_id: int) -> RobotStatus | None:
        """The robot's newest status, if it is not older than `FRESH_S`."""
        return self._robots[robot_id].fresh(self.now_s)

    def last(self, robot_id: int) -> tuple[RobotStatus, float] | None:
        """The robot's newest status and its age, s; None if there was none."""
        program = self._robots[robot_id].program
        return (
            None if program is None else (program.newest.status, self.now_s - program.newest.at_s)
        )

    def ground_age_s(self, robot_id: int) -> float:
        """Age of the newest ground state that the robot is known to have, s; infinite if none."""
        last = self.last(robot_id)
        if last is None or last[0].ground_age_s is None:
            return math.inf
        return last[0].ground_age_s + last[1]

    def others(self, robot_id: int) -> list[tuple[RobotStatus, float]]:
        """Fresh statuses, with their ages, s, of further programs with this robot's id."""
        return self._robots[robot_id].others(self.now_s)

    def statuses(self) -> dict[int, RobotStatus]:
        """Each robot's newest status that is not older than `FRESH_S`, by robot id."""
        fresh = ((id_, robot.fresh(self.now_s)) for id_, robot in self._robots.items())
        return {robot_id: status for robot_id, status in fresh if status is not None}

    def is_duplicate(self, robot_id: int) -> bool:
        """Whether two programs have this robot's id."""
        return self._robots[robot_id].duplicate

    def snapshots(self) -> tuple[RobotSnapshot, ...]:
        """Snapshots of all robots, in the fleet's order."""
        return tuple(robot.snapshot(self.now_s) for robot in self._robots.values())


def _rates_hz(first: RobotStatus, last: RobotStatus) -> dict[str, float]:
    passed_s = last.uptime_s - first.uptime_s
    if passed_s <= 0.0:
        return {}
    return {
        robot: max(0, count - first.neighbour_messages.get(robot, 0)) / passed_s
        for robot, count in last.neighbour_messages.items()
    }


def _arrivals(counts: Sequence[RadioCounts]) -> dict[str, tuple[int, ...]]:
    if not counts:
        return {}
    before = counts[0].arrivals
    return {
        robot: Arrivals.of_counts(its).since(Arrivals.of_counts(before.get(robot, ()))).counts
        for robot, its in counts[-1].arrivals.items()
    }
