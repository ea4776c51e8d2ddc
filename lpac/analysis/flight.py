"""A flight's record, whatever its source, and the numbers that follow from it.

Logs of robots, of a ground and of PX4, and simulators all give a `FlightRecord`, the only input of
reports and figures: `lpac sim` and `lpac report` give identical numbers for a flight. Definitions:

- The **mission** begins at the first status in which a robot flies it, and ends at the last one.
  Times are s from its begin, on the common clock (`lpac.analysis.logs`).
- **J**, the coverage cost, is evaluated at `cost_time_s`: each second of a fleet's flight, and at
  its end. Robots of the mission count while they report to be in the air (`in_air`), at their
  estimated positions, interpolated between two that are at most `FRESH_S` apart, else at the last
  one. A robot without a status for longer does not count. A robot in the air that reports no
  position counts, since the cost would jump otherwise. **True J** counts the same robots at their
  vehicles' true positions. Both are normalised by their own first value.
- The **least separation** is the 3-D distance of two robots in the air; the **fence margin** is the
  least horizontal distance inside the fence in the air. With estimated positions, both are from the
  mission's takeoff to its landing; with true positions, of all vehicles from the end of the mission
  before to the begin of the next.
- A robot's **share of the mission** is the time in which it reports to fly it.
- **Lloyd's algorithm** knows the world. It starts with the same number of robots at their first
  positions, and at random positions; its best result is for comparison, not a bound.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from edge.core import F64
from edge.core.fence import Fence
from edge.core.perception import part_in_world, window_corner
from edge.core.world import Feature
from edge.messages.codes import Reason, ReasonCode
from edge.messages.mission import AIRBORNE, ON_GROUND, FlightState
from lpac.analysis.coverage import Coverage
from lpac.analysis.logs import LoggedStatus, LoopRates
from lpac.analysis.snapshot import FRESH_S
from lpac.analysis.truth import TrueTrack

LOOPS = ("perception", "policy", "control")
COST_PERIOD_S = 1.0
_SEPARATION_PERIOD_S = 0.2
_TRUE_SEPARATION_PERIOD_S = 0.04
_SEEN_PERIOD_S = 0.2


class StateChange(NamedTuple):
    """A robot entered a state."""

    time_s: float
    state: FlightState
    reason: Reason


class Interval(NamedTuple):
    """A time in which a robot was in a state; s."""

    state: FlightState
    begin_s: float
    end_s: float


@dataclass(frozen=True, slots=True, eq=False)
class RobotRecord:
    """One robot's track and statuses in a flight; a simulated point has no statuses.

    `time_s` (T,), `position_m` (T, 3) in the mission frame with heights above the robot's pad, NaN
    where unknown, `flying` (T,). `statuses` (T,) are the statuses, if there are any.
    """

    robot_id: int
    name: str
    time_s: F64
    position_m: F64
    flying: npt.NDArray[np.bool_]
    statuses: tuple[LoggedStatus, ...] = ()

    def places_at(self, times_s: F64, *, remembered: bool = False) -> F64:
        """Positions (len(times_s), 3) in the air, m; NaN on the ground or if unknown.

        Interpolated between known positions that are at most `FRESH_S` apart. In longer gaps a
        position is the last one if `remembered`.
        """
        known = np.isfinite(self.position_m[:, 0])
        if not known.any():
            return np.full((len(times_s), 3), np.nan)
        latest = np.searchsorted(self.time_s, times_s, side="right") - 1
        in_air = (latest >= 0) & self.flying[latest]
        in_air &= times_s - self.time_s[latest] <= FRESH_S
        known_s, known_m = self.time_s[known], self.position_m[known]
        before = np.searchsorted(known_s, times_s, side="right") - 1
        after = np.minimum(before + 1, len(known_s) - 1)
        at = np.maximum(before, 0)
        in_air &= before >= 0
        if not remembered:
            in_air &= times_s - known_s[at] <= FRESH_S
        span_s = known_s[after] - known_s[at]
        share = np.clip((times_s - known_s[at]) / np.maximum(span_s, 1e-9), 0.0, 1.0)
        share = np.where(span_s <= FRESH_S, share, 0.0)[:, None]
        places_m = known_m[at] * (1.0 - share) + known_m[after] * share
        return np.where(in_air[:, None], places_m, np.nan)

    def intervals(self, end_s: float) -> list[Interval]:
        """The robot's states in order."""
        found: list[Interval] = []
        begins_s = self.time_s.tolist()
        ends_s = np.minimum([*begins_s[1:], end_s], self.time_s + FRESH_S).tolist()
        for status, begin_s, until_s in zip(self.statuses, begins_s, ends_s, strict=True):
            if found and found[-1].state is status.state and found[-1].end_s >= begin_s:
                found[-1] = found[-1]._replace(end_s=until_s)
            else:
                found.append(Interval(status.state, begin_s, until_s))
        return found


class Separation(NamedTuple):
    """Least 3-D distance of two robots in the air, m."""

    distance_m: float
    robots: tuple[str, str]
    time_s: float


class CommandEntry(NamedTuple):
    """A command of an operator, or a robot's answer."""

    time_s: float
    operator: str
    robot: str
    text: str
    done: bool


class FirstAlarm(NamedTuple):
    """First occurrence of an alarm of a robot."""

    time_s: float
    robot: str
    text: str
    code: ReasonCode


@dataclass(frozen=True, slots=True, eq=False)
class Messages:
    """Messages between a mission's robots, during the mission.

    `age_s` and `loss` (N, N), [receiver, sender]: median age, and share lost between the first and
    the last reception; NaN without any. `heard_at_s` and `heard_age_s` (M,) are times and ages of
    all receptions, s. `gaps` (G, 2): time of a reception, and number of messages lost before it.
    """

    age_s: F64
    loss: F64
    heard_at_s: F64
    heard_age_s: F64
    gaps: F64
    rejected: int

    @property
    def lost(self) -> int:
        return int(self.gaps[:, 1].sum())

    @property
    def loss_share(self) -> float:
        """NaN without any message."""
        sent = len(self.heard_at_s) + self.lost
        return self.lost / sent if sent else math.nan

    def age_quantile_s(self, share: float) -> float:
        """NaN without any message."""
        return quantile(self.heard_age_s, share)


@dataclass(frozen=True, slots=True, eq=False)
class LoopLateness:
    """Lateness of one robot's loop: (T,) time, s, and lateness in the minute before, ms."""

    time_s: F64
    p50_ms: F64
    p99_ms: F64
    max_ms: F64
    overruns: int
    failures: int


class ScriptCommand(NamedTuple):
    """A script's command as text, with codes of its problem and of each robot's result."""

    command: str
    done: bool
    problem: str | None
    results: Mapping[str, str]


class ProgramRecord(NamedTuple):
    """One robot's program in a script's flight.

    `changes` are its reported state changes, s from the script's start; `last` is its last status
    in the mission, or of all. `cpu_share` is of one core.
    """

    changes: tuple[StateChange, ...]
    last: LoggedStatus | None
    cpu_share: float
    peak_memory_mb: float
    logs: tuple[str, ...]

    @property
    def restarts(self) -> int:
        """Number of times the program returned into its mission."""
        return max(0, sum(c.state is FlightState.MISSION for c in self.changes) - 1)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ScriptRecord:
    """Course of a fleet's flight by a script; empty for other flights.

    The script started at `start_s` of the record's times. `began_s` has the start of each step, s
    from then; its last entry, `end`, is the end of the flight. `problem` is the reason of an early
    end, or None. `launcher` is the CPU use (share of a core) and memory (MB) of ground and vehicle
    processes. `vehicles_behind_s` and `robots_behind_s` are lags behind real time.
    """

    vehicle: str = ""
    start_s: float = 0.0
    began_s: Mapping[str, float] = field(default_factory=dict)
    problem: str | None = None
    commands: tuple[ScriptCommand, ...] = ()
    programs: tuple[ProgramRecord, ...] = ()
    launcher: tuple[float, float] = (0.0, 0.0)
    vehicles_behind_s: float = 0.0
    robots_behind_s: float = 0.0
    overloaded: bool = False


class GivenOrder(NamedTuple):
    """An order of the operator to robots, from the request to the answer.

    `ended_s` is inf while it is pending.
    """

    kind: str
    robots: tuple[int, ...]
    began_s: float
    ended_s: float


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class FaultRecord:
    """The fault in a drill's flight, and inputs of its bounds in addition to the true tracks.

    `hit` are the affected vehicles, `begin_s` is the fault's begin, `marks` further times by name.
    `pads_m` (N, 2) are the vehicles' true initial positions, `drone_m` their size. `late_s` is the
    lag behind real time of the machine that flew it; 0 on a simulated clock.
    """

    hit: tuple[int, ...] = ()
    begin_s: float = math.nan
    marks: Mapping[str, float] = field(default_factory=dict)
    orders: tuple[GivenOrder, ...] = ()
    pads_m: F64 = field(default_factory=lambda: np.zeros((0, 2)))
    drone_m: float = math.nan
    late_s: float = 0.0

    def ordered(self, kind: str, robot: int) -> list[GivenOrder]:
        """All orders of a kind to the robot."""
        return [each for each in self.orders if each.kind == kind and robot in each.robots]


@dataclass(frozen=True, eq=False, kw_only=True)
class FlightRecord:
    """One mission and its robots, from takeoff to landing; the module defines its numbers.

    Times are from the mission's begin at Unix time `begin_s`; the mission lasts `duration_s`.
    Without a mission they are from the flight's begin, and `duration_s` is 0. `from_s` and `to_s`
    limit the figures. `robots` are the mission's. `truth` has the vehicles' true tracks by name,
    also of other vehicles, and beyond the limits. Without a world `coverage` is None, and costs are
    empty. A sensor sees `sensor_size` cells of the world. With `clocks_known` the robots' clocks
    are corrected by the ground's log. `rates` are None if unknown, or if the robots' rates differ.
    Simulators also give the bundle's id, the world's `features` and, for points, the counts of
    messages by fate, and the largest absolute value in a payload.
    """

    name: str
    duration_s: float
    from_s: float
    to_s: float
    robots: tuple[RobotRecord, ...]
    coverage: Coverage | None
    sensor_size: int
    cost_time_s: F64
    begin_s: float = 0.0
    truth: Mapping[str, TrueTrack] = field(default_factory=dict)
    fence: Fence | None = None
    commands: tuple[CommandEntry, ...] = ()
    messages: Messages | None = None
    lateness: Mapping[str, Mapping[str, LoopLateness]] = field(default_factory=dict)
    world_ids: tuple[str, ...] = ()
    clocks_known: bool = False
    rates: LoopRates | None = None
    bundle_id: str = ""
    features: tuple[Feature, ...] = ()
    message_counts: Mapping[str, int] = field(default_factory=dict)
    largest_payload: float = 0.0
    script: ScriptRecord = ScriptRecord()
    fault: FaultRecord = FaultRecord()

    @property
    def of_points(self) -> bool:
        """Whether the robots are points, whose positions are true ones."""
        return not any(robot.statuses for robot in self.robots)

    @property
    def time_s(self) -> F64:
        """Sample times (T,) of points. Raises ValueError for other robots."""
        return self._points()[0].time_s

    @property
    def positions_m(self) -> F64:
        """Positions (T, N, 2) of points, m. Raises ValueError for other robots."""
        return np.stack([robot.position_m[:, :2] for robot in self._points()], axis=1)

    def _points(self) -> tuple[RobotRecord, ...]:
        if not (self.robots and self.of_points):
            raise ValueError(f"{self.name}: has no points")
        return self.robots

    @property
    def flew_mission(self) -> bool:
        """Whether there was a mission with a robot in flight."""
        return self.duration_s > 0.0

    @property
    def took_off(self) -> bool:
        """Whether a vehicle was in the air; without tracks, whether a program reported it."""
        if any(len(track.time_s) for track in self.vehicles):
            return any(track.airborne.any() for track in self.vehicles)
        changes = (change for program in self.script.programs for change in program.changes)
        return any(change.state in AIRBORNE for change in changes)

    @property
    def all_landed(self) -> bool:
        """Whether the fleet took off, and all are down and disarmed by reports and true tracks."""
        return (
            self.took_off
            and not any(track.airborne[-1:].any() for track in self.vehicles)
            and all(
                program.changes and program.changes[-1].state in ON_GROUND
                for program in self.script.programs
            )
        )

    @property
    def vehicles(self) -> tuple[TrueTrack, ...]:
        """True tracks in the order of `truth`."""
        return tuple(self.truth.values())

    @cached_property
    def _counted(self) -> tuple[F64, F64]:
        """Times (C,) with robots that count for J, and positions (C, N, 2), m, NaN for others."""
        if self.coverage is None or not len(self.cost_time_s):
            return np.zeros(0), np.zeros((0, len(self.robots), 2))
        places_m = np.stack(
            [r.places_at(self.cost_time_s, remembered=True)[:, :2] for r in self.robots], axis=1
        )
        counts = np.isfinite(places_m[..., 0]).any(axis=1)
        return self.cost_time_s[counts], places_m[counts]

    @property
    def curve_time_s(self) -> F64:
        """Times (C,) of `cost`, `true_cost` and their normalised curves."""
        return self._counted[0]

    @cached_property
    def cost(self) -> F64:
        """J (C,) in model units, at the robots' estimated positions."""
        return self._costs(self._counted[1])

    @cached_property
    def true_cost(self) -> F64:
        """J (C,) at the vehicles' true positions; NaN where one is unknown."""
        times_s, places_m = self._counted
        true_m = np.full_like(places_m, np.nan)
        for i, robot in enumerate(self.robots):
            if robot.name in self.truth:
                true_m[:, i] = self.truth[robot.name].positions_at(times_s)[:, :2]
        counted = np.isfinite(places_m[..., 0])
        known = (np.isfinite(true_m[..., 0]) | ~counted).all(axis=1)
        true_m[~counted] = np.nan
        cost = np.full(len(times_s), np.nan)
        cost[known] = self._costs(true_m[known])
        return cost

    def _costs(self, places_m: F64) -> F64:
        if self.coverage is None:
            return np.zeros(0)
        return np.array([self.coverage.cost(now_m[np.isfinite(now_m[:, 0])]) for now_m in places_m])

    @property
    def normalized(self) -> F64:
        """J over its first value; empty without a world, or if the world has no importance."""
        return _over_first(self.cost)

    @property
    def normalized_true(self) -> F64:
        """True J over its first value; NaN where unknown."""
        return _over_first(self.true_cost)

    @cached_property
    def lloyd(self) -> float:
        """J of Lloyd's algorithm, which knows the world; NaN if unknown."""
        _, places_m = self._counted
        if self.coverage is None or not len(places_m):
            return math.nan
        return self.coverage.lloyd(places_m[0][np.isfinite(places_m[0, :, 0])])

    @property
    def normalized_lloyd(self) -> float:
        """J of Lloyd's algorithm over the first J; NaN if unknown."""
        return self.lloyd / self.cost[0] if len(self.cost) and self.cost[0] else math.nan

    @cached_property
    def separation(self) -> Separation | None:
        """At estimated positions; None if two robots were never in the air together."""
        times_s = np.arange(self.from_s, self.to_s, _SEPARATION_PERIOD_S)
        return _least_distance(times_s, {r.name: r.places_at(times_s) for r in self.robots})

    @cached_property
    def true_separation(self) -> Separation | None:
        """At true positions; None also if a vehicle's track is unknown."""
        return least_separation(self.truth)

    @cached_property
    def fence_margin_m(self) -> float:
        """Margin at estimated positions; NaN if unknown."""
        return self._margin_m([robot.position_m[robot.flying] for robot in self.robots])

    @cached_property
    def true_fence_margin_m(self) -> float:
        """Margin at true positions; NaN if unknown."""
        return self._margin_m([track.position_m[track.airborne] for track in self.truth.values()])

    def _margin_m(self, places_m: list[F64]) -> float:
        if self.fence is None:
            return math.nan
        known_m = [(x_m, y_m) for of_one in places_m for x_m, y_m, _ in of_one.tolist()]
        return min(
            (self.fence.distance_m(x_m, y_m) for x_m, y_m in known_m if math.isfinite(x_m)),
            default=math.nan,
        )

    @cached_property
    def restarts(self) -> Mapping[str, int]:
        """Number of restarts of each program that restarted."""
        starts = {r.name: len({status.boot_nonce for status in r.statuses}) for r in self.robots}
        return {name: count - 1 for name, count in starts.items() if count > 1}

    @cached_property
    def alarms(self) -> tuple[FirstAlarm, ...]:
        """First occurrences of all alarms, in order of time."""
        first_s: dict[tuple[str, Reason], float] = {}
        for robot in self.robots:
            for status, time_s in zip(robot.statuses, robot.time_s.tolist(), strict=False):
                for alarm in status.alarms:
                    first_s.setdefault((robot.name, alarm), time_s)
        return tuple(
            sorted(
                FirstAlarm(time_s, robot, alarm.text, alarm.code)
                for (robot, alarm), time_s in first_s.items()
            )
        )

    def mission_share(self, robot: RobotRecord) -> float:
        """Share of the mission's time in which the robot flew the mission."""
        flown_s = sum(
            max(0.0, min(end_s, self.duration_s) - max(begin_s, 0.0))
            for state, begin_s, end_s in robot.intervals(self.to_s)
            if state is FlightState.MISSION
        )
        return flown_s / self.duration_s if self.duration_s > 0.0 else 0.0

    def places_at(self, time_s: float) -> dict[str, tuple[float, float]]:
        """Positions of the robots in the air, (x, y), m, by name."""
        found = {}
        for robot in self.robots:
            x_m, y_m, _ = robot.places_at(np.array([time_s]))[0].tolist()
            if math.isfinite(x_m):
                found[robot.name] = (x_m, y_m)
        return found

    def seen(self, time_s: float) -> npt.NDArray[np.bool_]:
        """Cells of the world [x, y] seen by a sensor in the mission until `time_s`."""
        assert self.coverage is not None
        world_size = len(self.coverage.importance)
        seen = np.zeros((world_size, world_size), np.bool_)
        times_s = np.append(np.arange(0.0, time_s, _SEEN_PERIOD_S), time_s)
        for robot in self.robots:
            places_m = robot.places_at(times_s)[:, :2]
            for place_m in places_m[np.isfinite(places_m[:, 0])]:
                corner = window_corner(place_m * self.coverage.cells_per_m, self.sensor_size)
                in_world, _ = part_in_world(corner, self.sensor_size, world_size)
                seen[in_world] = True
        return seen


def changes_of(times_s: Sequence[float], logged: Sequence[LoggedStatus]) -> tuple[StateChange, ...]:
    """State changes in a robot's statuses, with reasons."""
    return tuple(
        StateChange(time_s, status.state, status.reason)
        for k, (time_s, status) in enumerate(zip(times_s, logged, strict=True))
        if k == 0 or status.state is not logged[k - 1].state
    )


def least_separation(tracks: Mapping[str, TrueTrack]) -> Separation | None:
    """The least distance of two vehicles while both are in the air.

    None if two never were, or if a track is empty.
    """
    if not tracks or not all(len(track.time_s) for track in tracks.values()):
        return None
    first_s = min(track.time_s[0] for track in tracks.values())
    last_s = max(track.time_s[-1] for track in tracks.values())
    times_s = np.arange(first_s, last_s, _TRUE_SEPARATION_PERIOD_S)
    return _least_distance(times_s, {n: track.places_at(times_s) for n, track in tracks.items()})


def _least_distance(times_s: F64, places_m: Mapping[str, F64]) -> Separation | None:
    """`places_m` (T, 3) by name; NaN where a place does not count."""
    least: Separation | None = None
    for (one, at_m), (other, other_m) in itertools.combinations(places_m.items(), 2):
        distances_m = np.linalg.norm(at_m - other_m, axis=1)
        distances_m = np.where(np.isfinite(distances_m), distances_m, np.inf)
        k = int(distances_m.argmin()) if len(distances_m) else 0
        closest_m = float(distances_m[k]) if len(distances_m) else math.inf
        if math.isfinite(closest_m) and (least is None or closest_m < least.distance_m):
            least = Separation(closest_m, (one, other), float(times_s[k]))
    return least


def quantile(values: F64, share: float) -> float:
    """Quantile of the finite values; NaN if there are none."""
    known = values[np.isfinite(values)]
    return float(np.quantile(known, share)) if len(known) else math.nan


def _over_first(cost: F64) -> F64:
    return cost / cost[0] if len(cost) and cost[0] else np.zeros(0)
