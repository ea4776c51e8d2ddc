"""Statuses of a fleet's robots, as a ground station hears them.

Pure: it is as late as it was told. Robots are kept by id and boot nonce, that is by the start of a
program.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from edge.core.arrivals import Arrivals
from edge.messages.mission import RadioCounts, RobotStatus
from lpac.analysis.snapshot import FRESH_S, RobotSnapshot
from lpac.ground.rendering import state_and_reason

# Two statuses of one program, of which one is lost, are at most so far apart, unless it has ended.
_STATUS_GAP_S = 1.2
_RATE_WINDOW_S = 3.0
# In which a share of messages can be told.
_ARRIVALS_WINDOW_S = 10.0

# Keeps an event for the clients, as `Station.tell`.
Tell = Callable[..., None]


class _HeardStatus(NamedTuple):
    at_s: float
    clock_ahead_s: float
    status: RobotStatus


@dataclass(slots=True)
class _ProgramStart:
    """One start of a robot's program, and what it said within the last few seconds."""

    first_s: float
    heard: deque[_HeardStatus] = field(default_factory=deque)
    # What came of the other robots' messages meanwhile.
    arrivals: dict[str, tuple[int, ...]] = field(default_factory=dict)

    @property
    def newest(self) -> _HeardStatus:
        return self.heard[-1]

    def take(self, heard: _HeardStatus) -> bool:
        """Whether it is newer than what was heard before."""
        if self.heard and heard.status.sequence <= self.newest.status.sequence:
            return False
        self.heard.append(heard)
        changed = [heard]
        while heard.at_s - self.heard[0].at_s > _ARRIVALS_WINDOW_S:
            changed.append(self.heard.popleft())
        if any(h.status.radio_counts is not None for h in changed):
            counts = [h.status.radio_counts for h in self.heard]
            self.arrivals = _arrivals([each for each in counts if each is not None])
        return True

    def recent(self) -> list[_HeardStatus]:
        """Its statuses of the last few seconds, the newest last."""
        newest_at_s = self.newest.at_s
        return [h for h in self.heard if newest_at_s - h.at_s <= _RATE_WINDOW_S]


class _Robot:
    """One robot. Its program is the one that was there first, for as long as that speaks."""

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

    def take(self, heard: _HeardStatus) -> bool:
        """Whether it is a newer status of the robot's program."""
        nonce = heard.status.boot_nonce
        if not self._programs.setdefault(nonce, _ProgramStart(heard.at_s)).take(heard):
            return False
        program = self.program
        if program is None or heard.at_s - program.newest.at_s > _STATUS_GAP_S:
            self._nonce = nonce
        self._programs = {
            n: p
            for n, p in self._programs.items()
            if n == self._nonce or heard.at_s - p.newest.at_s <= FRESH_S
        }
        return nonce == self._nonce

    def two_speak(self, now_s: float) -> bool:
        """Whether two programs speak by turns: one that has ended falls silent instead."""
        alive = [p for p in self._programs.values() if now_s - p.newest.at_s <= FRESH_S]
        return len(alive) > 1 and max(p.first_s for p in alive) < min(p.newest.at_s for p in alive)

    def others(self, now_s: float) -> list[tuple[RobotStatus, float]]:
        """The newest status, and its age, s, of each other program that speaks."""
        newest = (p.newest for nonce, p in self._programs.items() if nonce != self._nonce)
        return [(h.status, now_s - h.at_s) for h in newest if now_s - h.at_s <= FRESH_S]

    def snapshot(self, now_s: float) -> RobotSnapshot:
        program = self.program
        if program is None:
            return RobotSnapshot(self.name, self.robot_id)
        recent, newest = program.recent(), program.newest.status
        return RobotSnapshot(
            name=self.name,
            robot_id=self.robot_id,
            status=newest,
            age_s=now_s - program.newest.at_s,
            # Delay only makes a clock look late.
            clock_offset_s=max(heard.clock_ahead_s for heard in recent),
            rates_hz=_rates_hz(recent[0].status, newest),
            arrivals=program.arrivals,
            duplicate=self.duplicate,
            other_release=self.other_release,
        )


class HeardRobots:
    """All robots of the fleet, by their ids, of which `robots` holds each name's."""

    def __init__(
        self, robots: Mapping[str, int], now_s: float, unix_now_s: float, tell: Tell
    ) -> None:
        self.names = {robot_id: name for name, robot_id in robots.items()}
        self.now_s, self.unix_now_s = now_s, unix_now_s
        self._began_s = now_s
        self._robots = {id_: _Robot(name, id_) for id_, name in self.names.items()}
        # By what their messages' envelopes tell: who is there twice, though one alone is heard.
        self.said_twice: frozenset[int] = frozenset()
        self._tell = tell

    @property
    def age_s(self) -> float:
        """How long they have been listened to, s."""
        return self.now_s - self._began_s

    def hear(self, status: RobotStatus, other_release: str = "") -> bool:
        """Whether that is a newer status of a robot's program than was known.

        It is not if the robot is of no name here, or if another program is that robot.
        """
        robot = self._robots.get(status.robot_id)
        if robot is None:
            return False
        before = None if robot.program is None else robot.program.newest.status
        if not robot.take(_HeardStatus(self.now_s, status.unix_time_s - self.unix_now_s, status)):
            return False
        robot.other_release = other_release
        if before is not None and before.boot_nonce != status.boot_nonce:
            self._tell("presence", robot.name, "its program has started again")
        if before is None or (before.state, before.reason) != (status.state, status.reason):
            self._tell("state", robot.name, state_and_reason(status))
        self._look_at(robot)
        return True

    def look(self) -> None:
        """Time has passed: see who fell silent, and who is there twice."""
        for robot in self._robots.values():
            self._look_at(robot)

    def _look_at(self, robot: _Robot) -> None:
        present = robot.fresh(self.now_s) is not None
        if present != robot.present:
            robot.present = present
            text = "heard" if present else f"silent for {FRESH_S:g} s"
            self._tell("presence", robot.name, text)
        duplicate = robot.two_speak(self.now_s) or robot.robot_id in self.said_twice
        if duplicate and not robot.duplicate:
            self._tell("presence", robot.name, "two programs say that they are this robot")
        robot.duplicate = duplicate

    def status(self, robot_id: int) -> RobotStatus | None:
        """The robot's newest, if it was heard within `FRESH_S`."""
        return self._robots[robot_id].fresh(self.now_s)

    def last(self, robot_id: int) -> tuple[RobotStatus, float] | None:
        """The robot's newest status, however old, and its age, s; None if it was never heard."""
        program = self._robots[robot_id].program
        return (
            None if program is None else (program.newest.status, self.now_s - program.newest.at_s)
        )

    def others(self, robot_id: int) -> list[tuple[RobotStatus, float]]:
        """The same of each other program that says it is this robot, if it is still heard."""
        return self._robots[robot_id].others(self.now_s)

    def statuses(self) -> dict[int, RobotStatus]:
        """The newest of each robot that was heard within `FRESH_S`, by robot id."""
        fresh = ((id_, robot.fresh(self.now_s)) for id_, robot in self._robots.items())
        return {robot_id: status for robot_id, status in fresh if status is not None}

    def is_duplicate(self, robot_id: int) -> bool:
        """Whether two programs say that they are this robot."""
        return self._robots[robot_id].duplicate

    def snapshots(self) -> tuple[RobotSnapshot, ...]:
        """State of each, in the fleet's order."""
        return tuple(robot.snapshot(self.now_s) for robot in self._robots.values())


def _rates_hz(first: RobotStatus, last: RobotStatus) -> dict[str, float]:
    passed_s = last.uptime_s - first.uptime_s
    if passed_s <= 0.0:
        return {}
    return {
        robot: max(0, count - first.neighbour_messages.get(robot, 0)) / passed_s
        for robot, count in last.neighbour_messages.items()
    }


def _arrivals(told: Sequence[RadioCounts]) -> dict[str, tuple[int, ...]]:
    if not told:
        return {}
    before = told[0].arrivals
    return {
        robot: Arrivals.of_counts(counts).since(Arrivals.of_counts(before.get(robot, ()))).counts
        for robot, counts in told[-1].arrivals.items()
    }
