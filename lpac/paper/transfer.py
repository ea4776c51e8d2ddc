"""Transfer, from the logs of flights: what teams of other sizes came to beside clairvoyant Lloyd's.

Missions are put together by their team: how many robots, and over how many features.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from edge.core import F64
from edge.core.counted import counted
from lpac.analysis.flight import FlightRecord
from lpac.evaluate.evaluation import (
    CLAIRVOYANT,
    FAILS_ABOVE,
    Condition,
    Method,
    MethodResult,
    TrainedBundle,
    conditions_json,
)
from lpac.evaluate.flights import POLICY
from lpac.sim.experiment import cost_times_s


def results_of_logs(
    missions: Mapping[str, FlightRecord],
    clairvoyant: Mapping[str, FlightRecord],
    bundle: TrainedBundle,
) -> dict[Condition, list[MethodResult]]:
    """By team, the smallest first: the missions that the bundle flew, and ClairvoyantCVT's flights.

    Both are by mission, and looked at for as long as the shortest mission lasted.
    """
    duration_s = min(float(record.curve_time_s[-1]) for record in missions.values())
    time_s = cost_times_s(duration_s)
    by_team: dict[tuple[int, int], list[str]] = {}
    for name, record in missions.items():
        features = 0 if record.coverage is None else len(record.coverage.features)
        by_team.setdefault((len(record.robots), features), []).append(name)
    results = {}
    for (robots, features), names in sorted(by_team.items()):
        own = [missions[name] for name in names]
        of_clairvoyant = _curves([clairvoyant[name] for name in names], time_s)
        results[Condition(f"{counted(robots, 'robot')}, {counted(features, 'feature')}")] = [
            MethodResult(
                method=method,
                time_s=time_s,
                curves=curves,
                clairvoyant=of_clairvoyant[:, :, -1],
                best_of_ten=np.array([[record.normalized_lloyd for record in own]]),
                lost_at_s=0.0,
            )
            for method, curves in (
                (Method(name=POLICY, flier=POLICY, trainings=(bundle,)), _curves(own, time_s)),
                (Method(name=CLAIRVOYANT, flier=CLAIRVOYANT), of_clairvoyant),
            )
        ]
    return results


def _curves(records: Sequence[FlightRecord], time_s: F64) -> F64:
    """(1, K, C): normalised costs."""
    return np.array([[np.interp(time_s, r.curve_time_s, r.normalized) for r in records]])


def as_json(
    results: Mapping[Condition, Sequence[MethodResult]], bundle: TrainedBundle
) -> dict[str, Any]:
    """As of an evaluation; of no set of worlds."""
    first = next(iter(results.values()))
    return {
        "world_set": None,
        "worlds": sum(of_all[0].curves.shape[1] for of_all in results.values()),
        "duration_s": float(first[0].time_s[-1]),
        "methods": [
            {"name": POLICY, "bundles": [bundle._asdict()]},
            {"name": CLAIRVOYANT, "bundles": []},
        ],
        "fails_above": FAILS_ABOVE,
        "conditions": conditions_json(results),
    }
