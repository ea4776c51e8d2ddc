"""Flights in which robots are removed and brought back."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from edge.core import F64
from edge.messages.mission import FlightState
from lpac.analysis.flight import FlightRecord
from lpac.sim.points import SAMPLE_S
from lpac.sim.scenario import Scenario

# A cost has settled when it stays within this share of its final value.
_SETTLED = 0.05


class Absence(NamedTuple):
    """Time in which a robot was away; s."""

    robot: str
    from_s: float
    until_s: float


def absences_of(record: FlightRecord) -> list[Absence]:
    """Times in the mission in which pilots flew robots."""
    piloted = [
        Absence(robot.name, interval.begin_s, min(interval.end_s, record.duration_s))
        for robot in record.robots
        for interval in robot.intervals(record.duration_s)
        if interval.state is FlightState.PILOT and 0.0 <= interval.begin_s < record.duration_s
    ]
    return sorted(piloted, key=lambda absence: absence.from_s)


class Phase(NamedTuple):
    """A time with a robot away, or back; costs are over the initial cost.

    `settled_s` is the time from the phase's begin until the cost stayed within 5 % of its last
    value.
    """

    robot: str
    away: bool
    from_s: float
    until_s: float
    cost_before: float
    cost_worst: float
    cost_end: float
    settled_s: float


@dataclass(frozen=True, slots=True, eq=False)
class PerturbedFlight:
    """A flight from which robots were removed, sampled at times (T,), s.

    `speed_m_s` and `neighbours` are (T, N), NaN while a robot is away.
    """

    record: FlightRecord
    absences: Sequence[Absence]
    time_s: F64
    speed_m_s: F64
    neighbours: F64
    phases: tuple[Phase, ...]


def perturbed_by(
    record: FlightRecord, absences: Sequence[Absence], range_m: float
) -> PerturbedFlight:
    """Evaluate a flight in which robots were away, one after another.

    Neighbours are within `range_m`. Raises ValueError if no robot was away.
    """
    if not absences:
        raise ValueError(f"{record.name}: no pilot took a robot in the mission")
    names = [robot.name for robot in record.robots]
    time_s = np.append(np.arange(0.0, record.duration_s - 1e-9, SAMPLE_S), record.duration_s)
    places_m = np.stack([robot.places_at(time_s)[:, :2] for robot in record.robots], axis=1)
    present = np.isfinite(places_m[..., 0])
    for name, from_s, until_s in absences:
        present[(time_s >= from_s) & (time_s < until_s), names.index(name)] = False
    speed_m_s = np.full(present.shape, np.nan)
    for robot, here in enumerate(present.T):
        if here.sum() > 1:
            # Interpolate linearly across gaps.
            path_m = np.stack(
                [np.interp(time_s, time_s[here], places_m[here, robot, k]) for k in (0, 1)], axis=1
            )
            speed_m_s[:, robot] = np.linalg.norm(np.gradient(path_m, time_s, axis=0), axis=1)
    apart_m = np.linalg.norm(places_m[:, :, None] - places_m[:, None], axis=3)
    heard = (apart_m < range_m) & present[:, :, None] & present[:, None, :]
    neighbours = heard.sum(axis=2) - 1.0
    for values in (speed_m_s, neighbours):
        values[~present] = np.nan
    ends_s = [absence.from_s for absence in absences[1:]] + [record.duration_s]
    phases = tuple(
        phase
        for (robot, from_s, until_s), end_s in zip(absences, ends_s, strict=True)
        for phase in (
            _phase(record, robot, away=True, from_s=from_s, until_s=until_s),
            _phase(record, robot, away=False, from_s=until_s, until_s=end_s),
        )
        if phase is not None
    )
    return PerturbedFlight(record, absences, time_s, speed_m_s, neighbours, phases)


def _phase(
    record: FlightRecord, robot: str, *, away: bool, from_s: float, until_s: float
) -> Phase | None:
    """None if the phase is too short for a cost."""
    times_s, cost = record.curve_time_s, record.normalized
    before, inside = cost[times_s < from_s], (times_s >= from_s) & (times_s < until_s)
    if not inside.any() or not len(before):
        return None
    phase_s, costs = times_s[inside], cost[inside]
    off = np.flatnonzero(np.abs(costs / costs[-1] - 1.0) > _SETTLED)
    return Phase(
        robot=robot,
        away=away,
        from_s=from_s,
        until_s=until_s,
        cost_before=float(before[-1]),
        cost_worst=float(costs.max()),
        cost_end=float(costs[-1]),
        settled_s=float(phase_s[off[-1]] - from_s) if len(off) else 0.0,
    )


def absences_in(scenario: Scenario) -> list[Absence]:
    """Times in which points fail and return, with the points' numbers as names."""
    return [Absence(str(f.robot), f.from_s, f.until_s) for f in scenario.failures]
