"""Trials in the logs, and what is to be said of each. Times are s from the trial's begin.

A trial begins when its first robot flies the mission of that name, and ends when the last one does
no more. A name that is flown again after all were on the ground, or reset, is another trial.
"""

import heapq
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from edge.core import F64
from edge.core.fence import Fence
from edge.core.perception import part_in_world, window_corner
from edge.messages.codes import Reason, ReasonCode
from edge.messages.mission import ON_GROUND, FlightState
from lpac.analysis.coverage import Coverage, in_air
from lpac.analysis.logs import LoggedStatus, Logs, Received
from lpac.analysis.mission_tracker import MissionTracker
from lpac.analysis.snapshot import FRESH_S

LOOPS = ("perception", "policy", "control")
_COST_PERIOD_S = 0.5
_MOST_COSTS = 600
_SEPARATION_PERIOD_S = 0.2
_SEEN_PERIOD_S = 0.2
# A mission of which there is one status lasted as long as one is valid for.
_LEAST_S = 0.25
# What is shown before takeoff and after landing.
_MARGIN_S = 3.0


class Interval(NamedTuple):
    """A robot was in a state; s."""

    state: FlightState
    begin_s: float
    end_s: float


@dataclass(frozen=True, slots=True, eq=False)
class RobotTrack:
    """What a robot said in a trial and around it.

    `time_s` (T,), `position_m` (T, 3), NaN where it did not know, `flying` (T,).
    """

    robot_id: int
    name: str
    said: tuple[LoggedStatus, ...]
    time_s: F64
    position_m: F64
    flying: npt.NDArray[np.bool_]

    def places_at(self, times_s: F64) -> F64:
        """(len(times_s), 3): where it was in the air, m; NaN where it was not, or is not known.

        Between two positions that it knew, no more than a moment apart, it is on the way.
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
        in_air &= (before >= 0) & (times_s - known_s[at] <= FRESH_S)
        span_s = known_s[after] - known_s[at]
        share = np.clip((times_s - known_s[at]) / np.maximum(span_s, 1e-9), 0.0, 1.0)
        share = np.where(span_s <= FRESH_S, share, 0.0)[:, None]
        places_m = known_m[at] * (1.0 - share) + known_m[after] * share
        return np.where(in_air[:, None], places_m, np.nan)

    def intervals(self, end_s: float) -> list[Interval]:
        """Its states, one after another."""
        found: list[Interval] = []
        begins_s = self.time_s.tolist()
        ends_s = np.minimum([*begins_s[1:], end_s], self.time_s + FRESH_S).tolist()
        for said, begin_s, until_s in zip(self.said, begins_s, ends_s, strict=True):
            if found and found[-1].state is said.state and found[-1].end_s >= begin_s:
                found[-1] = found[-1]._replace(end_s=until_s)
            else:
                found.append(Interval(said.state, begin_s, until_s))
        return found


class Separation(NamedTuple):
    """The least distance of two robots in the air, 3-D, as they said; m."""

    distance_m: float
    robots: tuple[str, str]
    time_s: float


class CommandEntry(NamedTuple):
    """Somebody commanded something, or a robot answered."""

    time_s: float
    operator: str
    robot: str
    text: str
    done: bool


class FirstAlarm(NamedTuple):
    """A robot had an alarm, first at a time."""

    time_s: float
    robot: str
    text: str
    code: ReasonCode


@dataclass(frozen=True, slots=True, eq=False)
class Messages:
    """The messages between a trial's robots, while it lasted.

    `age_s` and `loss` are (N, N), [receiver, sender]: the median age, and the share that did not
    come of what was sent from the first to the last that did; NaN where nothing came. `heard` are
    all that came: (M,) time, s, and age, s; `gaps` (G, 2) time and how many were missing before.
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
        ages = self.heard_age_s[np.isfinite(self.heard_age_s)]
        return float(np.quantile(ages, share)) if len(ages) else math.nan


@dataclass(frozen=True, slots=True, eq=False)
class LoopLateness:
    """A loop of one robot over the trial: (T,) time, s, and lateness in the minute before, ms."""

    time_s: F64
    p50_ms: F64
    p99_ms: F64
    max_ms: F64
    overruns: int
    failures: int


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One mission, and its robots from takeoff to landing.

    `begin_s` is Unix time; `from_s` and `to_s` are what is shown, s from there. `cost_time_s` and
    `cost` (C,), J in model units, are empty without a world; `bound` is the clairvoyant bound. A
    robot's sensor sees `sensor_size` cells of the world.
    """

    name: str
    begin_s: float
    duration_s: float
    from_s: float
    to_s: float
    tracks: tuple[RobotTrack, ...]
    coverage: Coverage | None
    sensor_size: int
    cost_time_s: F64
    cost: F64
    bound: float
    separation: Separation | None
    fence: Fence | None
    fence_margin_m: float
    restarts: Mapping[str, int]
    alarms: tuple[FirstAlarm, ...]
    commands: tuple[CommandEntry, ...]
    messages: Messages | None
    lateness: Mapping[str, Mapping[str, LoopLateness]]
    world_ids: tuple[str, ...]
    clocks_known: bool

    @property
    def normalized(self) -> F64:
        """J over the first; empty without a world, and over a world without importance."""
        return self.cost / self.cost[0] if len(self.cost) and self.cost[0] else np.zeros(0)

    @property
    def normalized_bound(self) -> float:
        """NaN if it is not known."""
        return self.bound / self.cost[0] if len(self.cost) and self.cost[0] else math.nan

    def places_at(self, time_s: float) -> dict[str, tuple[float, float]]:
        """Who was in the air where, m, by name."""
        found = {}
        for track in self.tracks:
            x_m, y_m, _ = track.places_at(np.array([time_s]))[0].tolist()
            if math.isfinite(x_m):
                found[track.name] = (x_m, y_m)
        return found

    def seen(self, time_s: float) -> npt.NDArray[np.bool_]:
        """Which cells of the world lay in a robot's sensor view in the mission so far, [x, y]."""
        assert self.coverage is not None
        world_size = len(self.coverage.importance)
        cells_per_m = world_size / self.coverage.size_m
        seen = np.zeros((world_size, world_size), np.bool_)
        times_s = np.append(np.arange(0.0, time_s, _SEEN_PERIOD_S), time_s)
        for track in self.tracks:
            places_m = track.places_at(times_s)[:, :2]
            for place_m in places_m[np.isfinite(places_m[:, 0])]:
                corner = window_corner(place_m * cells_per_m, self.sensor_size)
                in_world, _ = part_in_world(corner, self.sensor_size, world_size)
                seen[in_world] = True
        return seen


class Mission(NamedTuple):
    """When a mission was flown, by whom; Unix time of the common clock."""

    name: str
    begin_s: float
    end_s: float
    robots: tuple[int, ...]


def find_missions(logs: Logs) -> list[Mission]:
    """All missions, the first first."""
    mission_tracker = MissionTracker()
    parts: dict[str, list[dict[int, list[float]]]] = {}
    for robot_id, said in _in_order(logs):
        if mission_tracker.begins(robot_id, said, said.time_s):
            parts.setdefault(said.trial, []).append({})
        if said.state is FlightState.MISSION:
            parts[said.trial][-1].setdefault(robot_id, []).append(said.time_s)
    missions = [
        Mission(
            (name or "no name") + ("" if number == 1 else f" ({number})"),
            min(times_s[0] for times_s in part.values()),
            max(times_s[-1] for times_s in part.values()),
            tuple(sorted(part)),
        )
        for name, flown in parts.items()
        for number, part in enumerate(flown, 1)
    ]
    return sorted(missions, key=lambda mission: mission.begin_s)


def _in_order(logs: Logs) -> Iterator[tuple[int, LoggedStatus]]:
    """What all robots said, by robot id."""
    said = [zip(itertools.repeat(robot), statuses) for robot, statuses in logs.statuses.items()]
    return heapq.merge(*said, key=lambda one: one[1].time_s)


def trial_of(
    logs: Logs, mission: Mission, others: Sequence[Mission], coverage: Coverage | None,
    sensor_size: int, configured_fence: Fence | None,
) -> Trial:  # fmt: skip
    """All that is to be said of a mission; `others` bound what is shown of it."""
    begin_s, duration_s = mission.begin_s, max(mission.end_s - mission.begin_s, _LEAST_S)
    earliest_s = max(
        (o.end_s for o in others if o.end_s <= begin_s and set(o.robots) & set(mission.robots)),
        default=-math.inf,
    )
    latest_s = min(
        (o.begin_s for o in others if o.begin_s > begin_s and set(o.robots) & set(mission.robots)),
        default=math.inf,
    )
    flights = [_flight(logs.statuses[robot], mission) for robot in mission.robots]
    from_s = max(min(f for f, _ in flights) - _MARGIN_S, earliest_s) - begin_s
    to_s = min(max(t for _, t in flights) + _MARGIN_S, latest_s) - begin_s
    tracks = tuple(
        _track(robot, logs.name(robot), logs.statuses[robot], begin_s, from_s, to_s)
        for robot in mission.robots
    )
    cost_time_s, cost, bound = _costs(tracks, duration_s, coverage)
    fences = [said.fence for track in tracks for said in track.said if said.fence is not None]
    fence = fences[-1] if fences else configured_fence
    programs = {(track.robot_id, said.boot_nonce) for track in tracks for said in track.said}
    clocks_known = programs <= logs.clocks_known
    return Trial(
        name=mission.name,
        begin_s=begin_s,
        duration_s=duration_s,
        from_s=from_s,
        to_s=to_s,
        tracks=tracks,
        coverage=coverage,
        sensor_size=sensor_size,
        cost_time_s=cost_time_s,
        cost=cost,
        bound=bound,
        separation=_separation(tracks, from_s, to_s),
        fence=fence,
        fence_margin_m=_fence_margin_m(tracks, fence),
        restarts={t.name: n - 1 for t in tracks if (n := len({s.boot_nonce for s in t.said})) > 1},
        alarms=_alarms(tracks),
        commands=_commands(logs, mission, from_s, to_s),
        messages=_messages(logs, mission, clocks_known),
        lateness=_lateness(tracks, duration_s),
        world_ids=tuple(sorted({said.world_id for track in tracks for said in track.said})),
        clocks_known=clocks_known,
    )


def _flight(statuses: list[LoggedStatus], mission: Mission) -> tuple[float, float]:
    """When the robot left the ground for the mission, and was on it again."""
    times_s = [said.time_s for said in statuses]
    first, last = (int(np.searchsorted(times_s, at)) for at in (mission.begin_s, mission.end_s))
    first, last = min(first, len(times_s) - 1), min(last, len(times_s) - 1)
    while first > 0 and statuses[first].state not in ON_GROUND:
        first -= 1
    while last < len(statuses) - 1 and statuses[last].state not in ON_GROUND:
        last += 1
    return times_s[first], times_s[last]


def _track(
    robot_id: int,
    name: str,
    statuses: list[LoggedStatus],
    begin_s: float,
    from_s: float,
    to_s: float,
) -> RobotTrack:
    said = tuple(s for s in statuses if from_s <= s.time_s - begin_s <= to_s)
    nowhere = (math.nan, math.nan, math.nan)
    return RobotTrack(
        robot_id=robot_id,
        name=name,
        said=said,
        time_s=np.array([s.time_s - begin_s for s in said]),
        position_m=np.array([s.position_m or nowhere for s in said]).reshape(-1, 3),
        flying=np.array([in_air(s) for s in said], np.bool_),
    )


def _costs(
    tracks: tuple[RobotTrack, ...], duration_s: float, coverage: Coverage | None
) -> tuple[F64, F64, float]:
    if coverage is None:
        return np.zeros(0), np.zeros(0), math.nan
    period_s = max(_COST_PERIOD_S, duration_s / _MOST_COSTS)
    times_s = np.append(np.arange(0.0, duration_s - period_s / 2.0, period_s), duration_s)
    places_m = np.stack([track.places_at(times_s)[:, :2] for track in tracks], axis=1)
    flying = np.isfinite(places_m[..., 0])
    counts = flying.any(axis=1)
    times_s, places_m, flying = times_s[counts], places_m[counts], flying[counts]
    cost = [coverage.cost(now_m[known]) for now_m, known in zip(places_m, flying, strict=True)]
    bound = coverage.clairvoyant(places_m[0][flying[0]]) if cost else math.nan
    return times_s, np.array(cost), bound


def _separation(tracks: tuple[RobotTrack, ...], from_s: float, to_s: float) -> Separation | None:
    times_s = np.arange(from_s, to_s, _SEPARATION_PERIOD_S)
    places_m = [track.places_at(times_s) for track in tracks]
    least: Separation | None = None
    for i, j in itertools.combinations(range(len(tracks)), 2):
        distances_m = np.linalg.norm(places_m[i] - places_m[j], axis=1)
        distances_m = np.where(np.isfinite(distances_m), distances_m, np.inf)
        k = int(distances_m.argmin()) if len(distances_m) else 0
        closest_m = float(distances_m[k]) if len(distances_m) else math.inf
        if math.isfinite(closest_m) and (least is None or closest_m < least.distance_m):
            least = Separation(closest_m, (tracks[i].name, tracks[j].name), float(times_s[k]))
    return least


def _fence_margin_m(tracks: tuple[RobotTrack, ...], fence: Fence | None) -> float:
    """The least distance inside the fence, horizontally; NaN if there is no telling."""
    if fence is None:
        return math.nan
    places_m = np.concatenate([track.position_m[track.flying, :2] for track in tracks])
    known_m = places_m[np.isfinite(places_m[:, 0])].tolist()
    return min((fence.distance_m(x_m, y_m) for x_m, y_m in known_m), default=math.nan)


def _alarms(tracks: tuple[RobotTrack, ...]) -> tuple[FirstAlarm, ...]:
    first_s: dict[tuple[str, Reason], float] = {}
    for track in tracks:
        for said, time_s in zip(track.said, track.time_s.tolist(), strict=True):
            for alarm in said.alarms:
                first_s.setdefault((track.name, alarm), time_s)
    return tuple(
        sorted(
            FirstAlarm(time_s, robot, alarm.text, alarm.code)
            for (robot, alarm), time_s in first_s.items()
        )
    )


def _commands(logs: Logs, mission: Mission, from_s: float, to_s: float) -> tuple[CommandEntry, ...]:
    """From the ground's log; without one, the orders that robots answered."""
    begin_s = mission.begin_s
    told = [
        CommandEntry(
            event.unix_time_s - begin_s, event.operator, event.robot, event.text,
            event.kind != "refusal",
        )
        for event in logs.events
        if event.kind in ("command", "result", "refusal", "commander")
    ]  # fmt: skip
    told = [command for command in told if from_s <= command.time_s <= to_s]
    if not told:
        told = [
            CommandEntry(
                order.time_s - begin_s, order.operator, logs.name(order.robot_id),
                order.kind if order.refusal is None else f"{order.kind}: {order.refusal.text}",
                order.refusal is None,
            )
            for order in logs.orders
            if order.robot_id in mission.robots
        ]  # fmt: skip
    return tuple(command for command in told if from_s <= command.time_s <= to_s)


def _messages(logs: Logs, mission: Mission, clocks_known: bool) -> Messages | None:
    robots = mission.robots
    if not any(robot in logs.received for robot in robots):
        return None
    age_s, loss = np.full((2, len(robots), len(robots)), np.nan)
    heard, gaps, rejected = [], [], 0
    for row, receiver in enumerate(robots):
        received = logs.received.get(receiver)
        if received is None:
            continue
        during = (received.time_s >= mission.begin_s) & (received.time_s <= mission.end_s)
        rejected += int((during & (received.accepted == 0.0)).sum())
        for column, sender in enumerate(robots):
            own = during & (received.sender == sender) & (received.sequence >= 0)
            if not own.any():
                continue
            times_s = received.time_s[own] - mission.begin_s
            # Clocks are corrected to a few ms, and no message comes before it was sent.
            ages_s = received.age_s[own].clip(min=0.0 if clocks_known else -math.inf)
            missing = _missing(received, own)
            heard.append(np.stack([times_s, ages_s], axis=1))
            gaps.append(np.stack([times_s[1:], missing], axis=1)[missing > 0])
            age_s[row, column] = np.median(ages_s)
            loss[row, column] = missing.sum() / (missing.sum() + own.sum())
    all_heard = np.concatenate([np.zeros((0, 2)), *heard])
    return Messages(
        age_s, loss, all_heard[:, 0], all_heard[:, 1],
        np.concatenate([np.zeros((0, 2)), *gaps]), rejected,
    )  # fmt: skip


def _missing(received: Received, own: npt.NDArray[np.bool_]) -> F64:
    """(M - 1,): how many of a sender's messages are missing before each but the first.

    A sender that starts anew begins to count anew.
    """
    steps = np.diff(received.sequence[own])
    return np.where(steps > 0.0, steps - 1.0, 0.0)


def _lateness(
    tracks: tuple[RobotTrack, ...], duration_s: float
) -> dict[str, dict[str, LoopLateness]]:
    """Loop -> robot's name -> lateness; robots that said nothing in the mission are left out."""
    found: dict[str, dict[str, LoopLateness]] = {loop: {} for loop in LOOPS}
    for track in tracks:
        during = [
            (time_s, said)
            for time_s, said in zip(track.time_s.tolist(), track.said, strict=True)
            if 0.0 <= time_s <= duration_s
        ]
        for loop in LOOPS:
            known = [(time_s, said.loops[loop]) for time_s, said in during if loop in said.loops]
            if known:
                found[loop][track.name] = LoopLateness(
                    time_s=np.array([time_s for time_s, _ in known]),
                    p50_ms=np.array([status.lateness_p50_ms for _, status in known]),
                    p99_ms=np.array([status.lateness_p99_ms for _, status in known]),
                    max_ms=np.array([status.lateness_max_ms for _, status in known]),
                    overruns=_counted_up([status.overruns for _, status in known]),
                    failures=_counted_up([status.failures for _, status in known]),
                )
    return found


def _counted_up(counts: list[int]) -> int:
    """By how much a count grew; it begins anew with each start of the program."""
    return sum(max(after - before, 0) for before, after in itertools.pairwise(counts))
