"""The paper's experiments, from the logs of flights."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from edge.core import F64
from edge.core.counted import counted
from edge.policy.bundle import Bundle
from lpac.analysis.flight import FlightRecord
from lpac.sim.cores import Pool
from lpac.sim.description import FIELD_SCALE
from lpac.sim.experiment import cost_times_s
from lpac.sim.scenario import Scenario
from lpac.study.flights import CLAIRVOYANT, PlannedFlight, fly_all, records_of, sizes_of
from lpac.study.hearing_robot import message_bytes
from lpac.study.perturbation import absences_of, perturbed_by
from lpac.study.rates import rates, results_of_logs
from lpac.study.report import Report
from lpac.study.results import FAILS_ABOVE, MethodResult, conditions_json
from lpac.study.sections import Section, perturbation, repeatability, snapshots
from lpac.study.study import BASELINES, Condition, Method, TrainedBundle
from lpac.study.summary import LEGEND, draw_conditions, rows_of, tables_of

LOGS = "From the logs of flights."
_BY_RATES = (
    f"{LOGS} The missions of each rate are compared with those at the field's; costs are those of "
    "the robots' estimated positions."
)
_BESIDE_POINTS = (
    f"{LOGS} They are compared with points from where the robots were when the mission began."
)
_TAKEN = (
    "From the log of a flight: a robot counts as taken while a pilot has it; for the cost it still "
    "counts, at its place."
)
# The paper looks at trials for so long from the takeoff command on, s.
_TRIAL_S = 40.0


def baselines_beside(
    records: Mapping[str, FlightRecord], bundle: Path, sizes: str, names: Sequence[str], pool: Pool
) -> dict[str, dict[str, FlightRecord]]:
    """Baselines over the world of each logged flight, from where its robots began, as points.

    They fly at the field's scale of speeds, with a bundle's sizes. Flights whose world is not
    there, or that nobody began, are left out.
    """
    flights = {
        (trial, name): PlannedFlight(scenario=scenario, bundle=str(bundle), flown_by=sizes)
        for trial, record in records.items()
        for name, scenario in _beside(record).items()
        if name in names
    }
    flown = dict(fly_all(records_of, list(dict.fromkeys(flights.values())), pool))
    found: dict[str, dict[str, FlightRecord]] = {}
    for (trial, name), flight in flights.items():
        found.setdefault(trial, {})[name] = flown[flight]
    return found


def _beside(record: FlightRecord) -> dict[str, Scenario]:
    starts_m = tuple(record.places_at(0.0).values())
    if record.coverage is None or not record.coverage.features or not starts_m:
        return {}
    coverage = record.coverage
    return {
        name: Scenario(
            controller=name,
            robots=len(starts_m),
            features=coverage.features,
            starts_m=starts_m,
            world_size=len(coverage.importance),
            scale=replace(FIELD_SCALE, env_scale=coverage.cells_per_m),
            duration_s=record.duration_s,
        )
        for name in BASELINES
    }


def e1_of_logs(
    records: Mapping[str, Mapping[str, FlightRecord]], folder: Path, made_by: Mapping[str, str]
) -> Report:
    """E1: missions by name, each beside the baselines over its world."""
    beside = any(len(of_world) > 1 for of_world in records.values())
    flown = _BESIDE_POINTS if beside else LOGS
    return _report("e1", "E1, transferability", snapshots(records, folder), flown, made_by)


def e2_of_logs(
    records: Mapping[str, FlightRecord], folder: Path, made_by: Mapping[str, str]
) -> Report:
    """E2: each mission is a trial."""
    section = repeatability(records, folder, _TRIAL_S)
    return _report("e2", "E2, repeatability", section, LOGS, made_by)


def e3_of_logs(
    record: FlightRecord, range_m: float, folder: Path, made_by: Mapping[str, str]
) -> Report:
    """E3: robots are away while pilots have them. Raises ValueError if nobody was."""
    section = perturbation(perturbed_by(record, absences_of(record), range_m), folder)
    return _report("e3", "E3, perturbation", section, _TAKEN, made_by)


def async_of_logs(
    records: Mapping[str, FlightRecord], bundle: Bundle, folder: Path, made_by: Mapping[str, str]
) -> Report:
    """Missions by the rates that they were flown at. Raises ValueError."""
    section = rates(results_of_logs(records), message_bytes(bundle, 2), folder, paired=False)
    return _report("async", "Rates and asynchrony", section, _BY_RATES, made_by)


def _report(
    name: str, title: str, section: Section, flown: str, made_by: Mapping[str, str]
) -> Report:
    return Report(
        name=name, title=title, text=flown, told=section.told, rows=section.rows,
        tables=section.tables, figures=section.figures, flown=flown, made_by=made_by,
    )  # fmt: skip


def transfer_of_logs(
    records: Mapping[str, FlightRecord], bundle: Bundle, path: Path, pool: Pool, folder: Path,
    made_by: Mapping[str, str],
) -> Report:  # fmt: skip
    """Missions by team, how many robots and features, beside ClairvoyantCVT's flights.

    Raises ValueError if nobody was in the air as one began.
    """
    beside = baselines_beside(records, path, sizes_of(bundle), [CLAIRVOYANT], pool)
    for name in records:
        if name not in beside:
            raise ValueError(f"{name}: nobody was in the air as it began: choose other missions")
    clairvoyant = {name: its[CLAIRVOYANT] for name, its in beside.items()}
    policy = Method(name="lpac", trainings=(TrainedBundle(str(path.resolve()), bundle.id),))
    results = teams_of_logs(records, clairvoyant, policy)
    told: dict[str, Any] = {
        "world_set": None,
        "first_world": 0,
        "worlds": len(records),
        "trials_per_world": 1,
        "methods": [
            {"name": policy.name, "bundles": [each._asdict() for each in policy.trainings]},
            {"name": CLAIRVOYANT, "bundles": []},
        ],
        "fails_above": FAILS_ABOVE,
        "conditions": conditions_json(results),
    }
    return Report(
        name="transfer", title="Transfer to other teams and worlds", text=_BESIDE_POINTS,
        told=told, rows=rows_of(told), tables=tables_of(told),
        figures=draw_conditions(results, folder), flown=_BESIDE_POINTS, legend=LEGEND,
        made_by=made_by,
    )  # fmt: skip


def teams_of_logs(
    missions: Mapping[str, FlightRecord], clairvoyant: Mapping[str, FlightRecord], policy: Method
) -> dict[Condition, list[MethodResult]]:
    """By team, the smallest first: the missions that the policy flew, and ClairvoyantCVT's flights.

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
        condition = Condition(
            title=f"{counted(robots, 'robot')}, {counted(features, 'feature')}",
            scenario=replace(Condition().scenario, duration_s=duration_s),
        )
        results[condition] = [
            MethodResult(
                method=one,
                time_s=time_s,
                curves=curves,
                clairvoyant=of_clairvoyant[:, :, -1],
                best_of_ten=np.array([[record.normalized_lloyd for record in own]]),
                lost_at_s=0.0,
            )
            for one, curves in (
                (policy, _curves(own, time_s)),
                (Method(name=CLAIRVOYANT), of_clairvoyant),
            )
        ]
    return results


def _curves(records: Sequence[FlightRecord], time_s: F64) -> F64:
    """(1, K, C): normalised costs."""
    return np.array([[np.interp(time_s, r.curve_time_s, r.normalized) for r in records]])
