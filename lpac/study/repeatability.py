"""Trials of one flight, and how they differ."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from edge.messages.mission import FlightState
from lpac.analysis.flight import COST_PERIOD_S, FlightRecord


def looked_at_from_s(trials: Mapping[str, FlightRecord], duration_s: float) -> dict[str, float]:
    """When to begin to look at each trial for so long, by name; s, in the trial's own time.

    That is the takeoff command, or for all trials the mission's start, 0, if one of them has none,
    as points have not, or had it longer before.
    """
    found_s = {name: _takeoff_s(record) for name, record in trials.items()}
    if any(not -duration_s < at_s <= 0.0 for at_s in found_s.values()):
        return dict.fromkeys(trials, 0.0)
    return found_s


def _takeoff_s(record: FlightRecord) -> float:
    """When the first robot armed, which is what a takeoff command makes of it; NaN if none did."""
    armed_s = [
        time_s
        for robot in record.robots
        for time_s, status in zip(robot.time_s.tolist(), robot.statuses, strict=False)
        if status.state is FlightState.ARMING
    ]
    return min(armed_s, default=math.nan)


def looked_at(record: FlightRecord, from_s: float, duration_s: float) -> FlightRecord:
    """A trial from a time on for so long, or as much as there is; times count from it.

    Before the mission robots count for the cost where they stand, too.
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
    """How the costs at the end of the shortest, and the places there, differ.

    Places are compared of the robots that were in the air there in all trials; `missing` are the
    others, by trial. Raises ValueError if nobody was in all.
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


def who_is_missing(spread: Mapping[str, Any]) -> list[str]:
    """A sentence for each trial of `spread_of` in which a robot is missing."""
    return [
        f"At the end of {trial} not in the air, and so not compared: {', '.join(names)}."
        for trial, names in spread["missing"].items()
    ]
