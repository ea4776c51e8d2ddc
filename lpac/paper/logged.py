"""The paper's experiments, from logs of flights."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from edge.core import F64
from edge.core.counted import counted
from edge.policy.bundle import Bundle, load_bundle
from lpac.analysis.flight import FlightRecord
from lpac.sim.baselines import BaselineName
from lpac.sim.cores import Pool
from lpac.sim.description import FIELD_SCALE
from lpac.sim.points import cost_times_s
from lpac.sim.scenario import Scenario
from lpac.study.flights import CLAIRVOYANT, PlannedFlight, fly_all, records_of, sizes_of
from lpac.study.perturbation import absences_of, perturbed_by
from lpac.study.rates import LOGGED_S, is_comparable, rates, results_of_logs
from lpac.study.receiving_robot import message_bytes
from lpac.study.report import Report
from lpac.study.results import FAILS_ABOVE, MethodResult, conditions_json, over_mission
from lpac.study.sections import Section, perturbation, repeatability, snapshots
from lpac.study.study import BASELINES, Condition, Method, TrainedBundle
from lpac.study.summary import LEGEND, draw_conditions, rows_of, tables_of

LOGS = "From logs of flights."
_BY_RATES = (
    f"{LOGS} The missions of each rate are compared with those at the field's rates; costs are at "
    "the robots' estimated positions."
)
_BESIDE_POINTS = (
    f"{LOGS} They are compared with points from the robots' positions at the mission's begin."
)
_TAKEN = (
    "From the log of a flight: a robot counts as taken while a pilot flies it; it still counts for "
    "the cost, at its place."
)
# Duration of the paper's trials, from the takeoff command on, s.
_TRIAL_S = 40.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LoggedMissions:
    """Missions in the logs below a folder, by name, and the path of the flown bundle.

    The report goes to `folder`, with the provenance `made_by`. Points fly in the `pool`. `note` is
    called with remarks for the user.
    """

    records: Mapping[str, FlightRecord]
    bundle: Path
    logs: Path
    folder: Path
    made_by: Mapping[str, str]
    pool: Pool
    note: Callable[[str], object]

    def flown_bundle(self, why: str) -> Bundle:
        """Load the bundle; `why` is the reason in errors.

        Raises ValueError if another bundle flew, or it cannot fly.
        """
        bundle, flown = load_bundle(self.bundle), ids_in(self.records)
        if bundle.manifest.perception is None:
            raise ValueError(f"{self.bundle}: has no perception: it cannot fly")
        if len(flown) > 1:
            raise ValueError(
                f"missions were flown by {' and '.join(each[:16] for each in flown)}: choose those "
                "of one bundle with --trial"
            )
        if bundle.id not in flown:
            raise ValueError(
                f"{self.bundle}: another bundle flew, {flown[0][:16]}: give it with --bundle, {why}"
            )
        return bundle


def ids_in(records: Mapping[str, FlightRecord]) -> list[str]:
    """Ids of the flown bundles."""
    robots = [robot for record in records.values() for robot in record.robots]
    return sorted({status.bundle_id for robot in robots for status in robot.statuses})


def _e1(of: LoggedMissions) -> Report:
    """E1: each mission, with baselines over its world if the bundle flew it."""
    bundle = load_bundle(of.bundle)
    others = [name for name, record in of.records.items() if ids_in({name: record}) != [bundle.id]]
    if others:
        of.note(
            f"no baselines for {', '.join(others)}: another bundle than {of.bundle} flew, so their "
            "sizes are unknown; give that bundle with --bundle"
        )
    own = {name: record for name, record in of.records.items() if name not in others}
    beside = _baselines_beside(own, of, sizes_of(bundle), BASELINES)
    by_mission = {
        name: {"flight": record, **beside.get(name, {})} for name, record in of.records.items()
    }
    section = snapshots(by_mission, of.folder)
    return section.report(
        "e1", "E1, transferability", _BESIDE_POINTS if beside else LOGS, of.made_by
    )


def _baselines_beside(
    records: Mapping[str, FlightRecord],
    of: LoggedMissions,
    sizes: str,
    names: Sequence[BaselineName],
) -> dict[str, dict[str, FlightRecord]]:
    """Baselines over the world of each logged flight, from its robots' first positions, as points.

    They fly at the field's speed scale, with a bundle's sizes. Flights without a world, or without
    robots in the air at their begin, are skipped.
    """
    flights = {
        (mission, name): PlannedFlight(scenario=scenario, bundle=str(of.bundle), flown_by=sizes)
        for mission, record in records.items()
        for name, scenario in _beside(record, names).items()
    }
    flown = dict(fly_all(records_of, list(dict.fromkeys(flights.values())), of.pool))
    found: dict[str, dict[str, FlightRecord]] = {}
    for (mission, name), flight in flights.items():
        found.setdefault(mission, {})[name] = flown[flight]
    return found


def _beside(record: FlightRecord, names: Sequence[BaselineName]) -> dict[str, Scenario]:
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
        for name in names
    }


def _e2(of: LoggedMissions) -> Report:
    """E2: each mission is a trial. Raises ValueError if there is only one."""
    if len(of.records) < 2:
        raise ValueError(f"missions in {of.logs}: {len(of.records)}: must be at least 2")
    section = repeatability(of.records, of.folder, _TRIAL_S)
    return section.report("e2", "E2, repeatability", LOGS, of.made_by)


def _e3(of: LoggedMissions) -> Report:
    """E3: robots are away while pilots fly them.

    Raises ValueError if none was, or there are several missions.
    """
    if len(of.records) > 1:
        raise ValueError(f"{of.logs}: has {', '.join(of.records)}: choose one mission with --trial")
    perception = of.flown_bundle("which has the communication range").manifest.perception
    assert perception is not None
    range_m = perception.communication_range / FIELD_SCALE.env_scale
    [record] = of.records.values()
    section = perturbation(perturbed_by(record, absences_of(record), range_m), of.folder)
    return section.report("e3", "E3, perturbation", _TAKEN, of.made_by)


def _async(of: LoggedMissions) -> Report:
    """Missions by their rates. Raises ValueError."""
    bundle = of.flown_bundle("which has the size of messages")
    for name, record in of.records.items():
        if not is_comparable(record):
            why = (
                "its robots' rates differ, or are not in their logs"
                if record.rates is None
                else f"it lasted {record.curve_time_s[-1]:.0f} s, less than {LOGGED_S:g}"
            )
            of.note(f"{name} is left out: {why}")
    message_size = message_bytes(bundle, 2)
    section = rates(results_of_logs(of.records), message_size, of.folder, paired=False)
    return section.report("async", "Rates and asynchrony", _BY_RATES, of.made_by)


def _transfer(of: LoggedMissions) -> Report:
    """Missions by team (numbers of robots and features), with ClairvoyantCVT's flights.

    Raises ValueError if a mission began without robots in the air.
    """
    bundle = of.flown_bundle("which has the baselines' sizes")
    beside = _baselines_beside(of.records, of, sizes_of(bundle), [CLAIRVOYANT])
    for name in of.records:
        if name not in beside:
            raise ValueError(f"{name}: no robot was in the air at its begin: choose other missions")
    clairvoyant = {name: flights[CLAIRVOYANT] for name, flights in beside.items()}
    path = str(of.bundle.resolve())
    policy = Method(name="lpac", trainings=(TrainedBundle(path, bundle.id),))
    results = _by_team(of.records, clairvoyant, policy)
    data: dict[str, Any] = {
        "world_set": None,
        "first_world": 0,
        "worlds": len(of.records),
        "trials_per_world": 1,
        "methods": [
            {"name": policy.name, "bundles": [each._asdict() for each in policy.trainings]},
            {"name": CLAIRVOYANT, "bundles": []},
        ],
        "fails_above": FAILS_ABOVE,
        "conditions": conditions_json(results),
    }
    section = Section(data, tables_of(data), draw_conditions(results, of.folder), rows_of(data))
    title = "Transfer to other teams and worlds"
    return replace(section.report("transfer", title, _BESIDE_POINTS, of.made_by), legend=LEGEND)


def _by_team(
    missions: Mapping[str, FlightRecord], clairvoyant: Mapping[str, FlightRecord], policy: Method
) -> dict[Condition, list[MethodResult]]:
    """By team, the smallest first: missions flown by the policy, and ClairvoyantCVT's flights.

    Both are by mission, and cut to the shortest mission.
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
                clairvoyant_over_mission=over_mission(time_s, of_clairvoyant),
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
    """Normalised costs (1, K, C)."""
    return np.array([[np.interp(time_s, r.curve_time_s, r.normalized) for r in records]])


REPORTS: Mapping[str, Callable[[LoggedMissions], Report]] = {
    "e1": _e1, "e2": _e2, "e3": _e3, "async": _async,
    "transfer": _transfer,
}  # fmt: skip
