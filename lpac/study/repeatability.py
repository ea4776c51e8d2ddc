"""Compares trials of one flight."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from edge.messages.mission import FlightState
from lpac.analysis.flight import COST_PERIOD_S, FlightRecord


def evaluation_start_s(trials: Mapping[str, FlightRecord], duration_s: float) -> dict[str, float]:
    """Start of the evaluated time of each trial, by name; s, in the trial's own time.

    The start is the takeoff command. It is 0, the mission's start, for all trials if one of them
    has no takeoff (points), or an earlier one than `duration_s` before.
    """
    found_s = {name: _takeoff_s(record) for name, record in trials.items()}
    if any(not -duration_s < at_s <= 0.0 for at_s in found_s.values()):
        return dict.fromkeys(trials, 0.0)
    return found_s


def _takeoff_s(record: FlightRecord) -> float:
    """Time of the takeoff command, when the first robot arms; NaN without one."""
    armed_s = [
        time_s
        for robot in record.robots
        for time_s, status in zip(robot.time_s.tolist(), robot.statuses, strict=False)
        if status.state is FlightState.ARMING
    ]
    return min(armed_s, default=math.nan)


def evaluated_part(record: FlightRecord, from_s: float, duration_s: float) -> FlightRecord:
    """Part of a trial of at most `duration_s`, with times relative to `from_s`.

    Before the mission, robots on the ground also count for the cost.
    """
    end_s = min(duration_s, record.duration_s - from_s)
    robots = tuple(
        replace(
            robot,
            time_s=robot.time_s - from_s,
            flying=robot.flying | (robot.time_s < 0.0) if from_s < 0.0 else robot.flying,
        )
        for robot in record.robots
    )
    return replace(
        record,
        begin_s=record.begin_s + from_s,
        duration_s=end_s,
        from_s=0.0,
        to_s=end_s,
        robots=robots,
        truth={name: track.shifted(-from_s) for name, track in record.truth.items()},
        cost_time_s=np.append(np.arange(0.0, end_s - COST_PERIOD_S / 2.0, COST_PERIOD_S), end_s),
    )


def spread_of(records: Mapping[str, FlightRecord]) -> dict[str, Any]:
    """Differences of costs and positions at the end of the shortest trial.

    Positions are compared for robots in the air in all trials; `missing` names the others by trial.
    Raises ValueError if there are none in common.
    """
    end_s = min(float(record.curve_time_s[-1]) for record in records.values())
    times_s = np.append(np.arange(0.0, end_s, 1.0), end_s)
    curves = np.array([np.interp(times_s, r.curve_time_s, r.normalized) for r in records.values()])
    ends_m = {trial: record.places_at(end_s) for trial, record in records.items()}
    robots = dict.fromkeys(robot.name for record in records.values() for robot in record.robots)
    missing = {
        trial: [name for name in robots if name not in places_m]
        for trial, places_m in ends_m.items()
    }
    common = [name for name in robots if not any(name in names for names in missing.values())]
    if not common:
        raise ValueError("no robot was in the air at the end of all trials")
    common_m = np.array([[places_m[name] for name in common] for places_m in ends_m.values()])
    scatter_m = np.linalg.norm(common_m - common_m.mean(axis=0), axis=2)
    return {
        "end_s": end_s,
        "final_mean": float(curves[:, -1].mean()),
        "final_deviation": float(curves[:, -1].std(ddof=1)),
        "largest_deviation_in_flight": float(curves.std(axis=0, ddof=1).max()),
        "mean_scatter_of_ends_m": float(scatter_m.mean()),
        "missing": {trial: names for trial, names in missing.items() if names},
    }


def not_compared(spread: Mapping[str, Any]) -> list[str]:
    """A sentence for each trial of `spread_of` that lacks robots."""
    return [
        f"Not compared, because not in the air at the end of {trial}: {', '.join(names)}."
        for trial, names in spread["missing"].items()
    ]
