"""Finds missions in logs and makes their records.

After all robots were on the ground, or a reset, a mission of the same name is a new one.
"""

import contextlib
import heapq
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from edge.core import F64
from edge.core.fence import Fence
from edge.messages.mission import ON_GROUND, FlightState
from lpac.analysis.coverage import Coverage, in_air
from lpac.analysis.flight import (
    COST_PERIOD_S,
    LOOPS,
    CommandEntry,
    FlightRecord,
    LoopLateness,
    Messages,
    RobotRecord,
    quantile,
)
from lpac.analysis.logs import (
    LoggedStatus,
    Logs,
    LoopRates,
    Program,
    Received,
    configured,
)
from lpac.analysis.mission_tracker import MissionTracker
from lpac.analysis.truth import TrueTrack

# Least duration of a mission, the time for which one status is valid.
_LEAST_S = 0.25
# Time shown before takeoff and after landing.
_MARGIN_S = 3.0


class Mission(NamedTuple):
    """Time and robots of a mission; Unix time of the common clock."""

    name: str
    begin_s: float
    end_s: float
    robots: tuple[int, ...]


def find_missions(logs: Logs) -> list[Mission]:
    """All missions, in order of time."""
    mission_tracker = MissionTracker()
    parts: dict[str, list[dict[int, list[float]]]] = {}
    for robot_id, status in _in_order(logs):
        if mission_tracker.begins(robot_id, status, status.time_s):
            parts.setdefault(status.trial, []).append({})
        if status.state is FlightState.MISSION:
            parts[status.trial][-1].setdefault(robot_id, []).append(status.time_s)
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
    """All robots' ids and statuses in order of time."""
    streams = [zip(itertools.repeat(robot), statuses) for robot, statuses in logs.statuses.items()]
    return heapq.merge(*streams, key=lambda one: one[1].time_s)


def record_of(
    logs: Logs, mission: Mission, others: Sequence[Mission], coverage: Coverage | None,
    sensor_size: int, configured_fence: Fence | None,
) -> FlightRecord:  # fmt: skip
    """The record of a mission; `others` with the same robots limit its time."""
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
    cost_time_s = np.append(
        np.arange(0.0, duration_s - COST_PERIOD_S / 2.0, COST_PERIOD_S), duration_s
    )
    return _record(
        logs, mission, duration_s, (from_s, to_s), (earliest_s, latest_s), cost_time_s, coverage,
        sensor_size, configured_fence,
    )  # fmt: skip


def whole_record(
    logs: Logs, robots: Sequence[int], coverage: Coverage | None, sensor_size: int,
    configured_fence: Fence | None,
) -> FlightRecord:  # fmt: skip
    """The record of a flight without a mission."""
    times_s = [status.time_s for robot in robots for status in logs.statuses.get(robot, ())]
    begin_s, end_s = min(times_s, default=0.0), max(times_s, default=0.0)
    return _record(
        logs, Mission("no mission", begin_s, begin_s, tuple(robots)), 0.0, (0.0, end_s - begin_s),
        (-math.inf, math.inf), np.zeros(0), coverage, sensor_size, configured_fence,
    )  # fmt: skip


def _record(
    logs: Logs, mission: Mission, duration_s: float, shown_s: tuple[float, float],
    within_s: tuple[float, float], cost_time_s: F64, coverage: Coverage | None, sensor_size: int,
    configured_fence: Fence | None,
) -> FlightRecord:  # fmt: skip
    begin_s, (from_s, to_s) = mission.begin_s, shown_s
    robots = tuple(
        _robot(robot, logs.name(robot), logs.statuses.get(robot, []), begin_s, from_s, to_s)
        for robot in mission.robots
    )
    fences = [s.fence for robot in robots for s in robot.statuses if s.fence is not None]
    programs = {(robot.robot_id, s.boot_nonce) for robot in robots for s in robot.statuses}
    clocks_known = programs <= logs.clocks_known
    return FlightRecord(
        name=mission.name,
        begin_s=begin_s,
        duration_s=duration_s,
        from_s=from_s,
        to_s=to_s,
        robots=robots,
        truth=_truth(logs, mission, *within_s),
        coverage=coverage,
        sensor_size=sensor_size,
        cost_time_s=cost_time_s,
        fence=fences[-1] if fences else configured_fence,
        commands=_commands(logs, mission, from_s, to_s),
        messages=_messages(logs, mission),
        lateness=_lateness(robots, duration_s),
        world_ids=tuple(sorted({status.world_id for robot in robots for status in robot.statuses})),
        clocks_known=clocks_known,
        rates=_rates(logs, programs),
    )


def _rates(logs: Logs, programs: set[Program]) -> LoopRates | None:
    """Rates of these programs; None if they differ or one is unknown."""
    known: dict[Program, LoopRates] = {}
    for metadata in logs.metadata:
        rates = configured(metadata, "rates")
        with contextlib.suppress(ValueError, KeyError, TypeError):
            known[metadata.robot_id, metadata.boot_nonce] = LoopRates(
                *(float(rates[name]) for name in LoopRates._fields)
            )
    found = {known.get(program) for program in programs}
    return found.pop() if len(found) == 1 else None


def _truth(logs: Logs, mission: Mission, from_s: float, to_s: float) -> dict[str, TrueTrack]:
    """True tracks of the simulation in which the mission was flown; empty if there is none."""
    for tracks in logs.truths:
        own = [tracks[robot] for robot in mission.robots if robot in tracks]
        if any(len(t.time_s) and t.time_s[0] <= mission.begin_s <= t.time_s[-1] for t in own):
            return {
                logs.name(robot): track.between(from_s, to_s).shifted(-mission.begin_s)
                for robot, track in tracks.items()
            }
    return {}


def _flight(statuses: list[LoggedStatus], mission: Mission) -> tuple[float, float]:
    """Times of the robot's takeoff for the mission and its landing."""
    times_s = [status.time_s for status in statuses]
    first, last = (int(np.searchsorted(times_s, at)) for at in (mission.begin_s, mission.end_s))
    first, last = min(first, len(times_s) - 1), min(last, len(times_s) - 1)
    while first > 0 and statuses[first].state not in ON_GROUND:
        first -= 1
    while last < len(statuses) - 1 and statuses[last].state not in ON_GROUND:
        last += 1
    return times_s[first], times_s[last]


def _robot(
    robot_id: int,
    name: str,
    statuses: list[LoggedStatus],
    begin_s: float,
    from_s: float,
    to_s: float,
) -> RobotRecord:
    shown = tuple(s for s in statuses if from_s <= s.time_s - begin_s <= to_s)
    nowhere = (math.nan, math.nan, math.nan)
    return RobotRecord(
        robot_id=robot_id,
        name=name,
        statuses=shown,
        time_s=np.array([s.time_s - begin_s for s in shown]),
        position_m=np.array([s.position_m or nowhere for s in shown]).reshape(-1, 3),
        flying=np.array([in_air(s) for s in shown], np.bool_),
    )


def _commands(logs: Logs, mission: Mission, from_s: float, to_s: float) -> tuple[CommandEntry, ...]:
    """Commands in the ground's log; without one, the orders that robots answered."""
    begin_s = mission.begin_s
    commands = [
        CommandEntry(
            event.unix_time_s - begin_s, event.operator, event.robot, event.text,
            event.kind != "refusal",
        )
        for event in logs.events
        if event.kind in ("command", "result", "refusal", "commander")
    ]  # fmt: skip
    commands = [command for command in commands if from_s <= command.time_s <= to_s]
    if not commands:
        commands = [
            CommandEntry(
                order.time_s - begin_s, order.operator, logs.name(order.robot_id),
                order.kind if order.refusal is None else f"{order.kind}: {order.refusal.text}",
                order.refusal is None,
            )
            for order in logs.orders
            if order.robot_id in mission.robots
        ]  # fmt: skip
    return tuple(command for command in commands if from_s <= command.time_s <= to_s)


def _messages(logs: Logs, mission: Mission) -> Messages | None:
    robots = mission.robots
    if not any(robot in logs.received for robot in robots):
        return None
    age_s, loss = np.full((2, len(robots), len(robots)), np.nan)
    arrivals, gaps, rejected = [], [], 0
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
            ages_s = received.age_s[own]
            missing = _missing(received, own)
            arrivals.append(np.stack([times_s, ages_s], axis=1))
            gaps.append(np.stack([times_s[1:], missing], axis=1)[missing > 0])
            age_s[row, column] = quantile(ages_s, 0.5)
            loss[row, column] = missing.sum() / (missing.sum() + own.sum())
    all_received = np.concatenate([np.zeros((0, 2)), *arrivals])
    return Messages(
        age_s, loss, all_received[:, 0], all_received[:, 1],
        np.concatenate([np.zeros((0, 2)), *gaps]), rejected,
    )  # fmt: skip


def _missing(received: Received, own: npt.NDArray[np.bool_]) -> F64:
    """Number of messages lost before each of a sender's messages but the first: (M - 1,).

    A restarted sender counts from 0 again.
    """
    steps = np.diff(received.sequence[own])
    return np.where(steps > 0.0, steps - 1.0, 0.0)


def _lateness(
    robots: tuple[RobotRecord, ...], duration_s: float
) -> dict[str, dict[str, LoopLateness]]:
    """Loop -> robot's name -> lateness; robots without a status in the mission are left out."""
    found: dict[str, dict[str, LoopLateness]] = {loop: {} for loop in LOOPS}
    for robot in robots:
        during = [
            (time_s, status)
            for time_s, status in zip(robot.time_s.tolist(), robot.statuses, strict=True)
            if 0.0 <= time_s <= duration_s
        ]
        for loop in LOOPS:
            known = [(time_s, s.loops[loop]) for time_s, s in during if loop in s.loops]
            if known:
                found[loop][robot.name] = LoopLateness(
                    time_s=np.array([time_s for time_s, _ in known]),
                    p50_ms=np.array([status.lateness_p50_ms for _, status in known]),
                    p99_ms=np.array([status.lateness_p99_ms for _, status in known]),
                    max_ms=np.array([status.lateness_max_ms for _, status in known]),
                    overruns=_counted_up([status.overruns for _, status in known]),
                    failures=_counted_up([status.failures for _, status in known]),
                )
    return found


def _counted_up(counts: list[int]) -> int:
    """Growth of a counter that restarts at 0 with the program."""
    return sum(max(after - before, 0) for before, after in itertools.pairwise(counts))
