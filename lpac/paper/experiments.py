"""The paper's three experiments in the air: with points that fly what the policy decides, or whole.

Each is a plan: named scenarios, and from what they came to the numbers, which are those of flight
records, so that a field day's logs give the same. What points leave out is said in each report.

A record's cost is that of the places in it. Points' are where they truly are; those of whole robots
and of logs are where the robots took themselves to be, and where the vehicles tell, the true cost
is known beside it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from edge.core import F64
from edge.messages.mission import FlightState
from lpac.analysis.flight import COST_PERIOD_S, FlightRecord
from lpac.evaluate.flights import BASELINES
from lpac.evaluate.worlds import FIELD as FIELD_SET_UP
from lpac.evaluate.worlds import DrawnWorld, draw_world
from lpac.sim.description import FIELD_SCALE
from lpac.sim.experiment import SAMPLE_S, SimulatedFlight
from lpac.sim.failure import Failure
from lpac.sim.fleet.layout import Layout, pads_for_all
from lpac.sim.scenario import Controller, Scenario

# E1: who flies, and when the field is looked at, s.
_CONTROLLERS: tuple[Controller, ...] = ("lpac", *BASELINES)
SNAPSHOTS_S = (0.0, 15.0, 30.0, 60.0)
# What these are called beside the points.
WHOLE_ROBOTS = "whole robots"
# E2: how far from their pads robots are placed, m, how wrong their receivers are, m, and for how
# long the paper looks, s.
PLACED_WITHIN_M = 0.1
GPS_ERROR_M = (1.0, 5.0)
E2_DURATION_S = 40.0
# E3: when the first robot is taken, for how long, and how long after its return the next is, s.
TAKEN_AT_S, AWAY_S, BACK_S = 60.0, 20.0, 40.0
TAKEN = (0, 3, 7)
_E3_DURATION_S = TAKEN_AT_S + len(TAKEN) * (AWAY_S + BACK_S)
# Settled is what stays within so much of what it comes to in the end.
_SETTLED = 0.05


def _world(number: int) -> DrawnWorld:
    return draw_world("validation", number, FIELD_SET_UP)


def _starts_m(world: DrawnWorld) -> F64:
    starts_m: F64 = FIELD_SCALE.position_to_mission_m(np.array(world.starts))
    return starts_m


def _pairs(rows: F64) -> tuple[tuple[float, float], ...]:
    return tuple((x, y) for x, y in rows.tolist())


def transferability(worlds: int = 3, starts_m: F64 | None = None) -> dict[str, dict[str, Scenario]]:
    """E1: worlds that no policy was trained on, the same starts; by world, and who flies.

    `starts_m` (N, 2) are the first world's if none are given.
    """
    starts = _pairs(_starts_m(_world(0)) if starts_m is None else starts_m)
    return {
        f"world {number}": {
            controller: Scenario(
                controller=controller,
                robots=FIELD_SET_UP.robots,
                seed=world.seed,
                features=world.features,
                starts_m=starts,
                duration_s=SNAPSHOTS_S[-1],
            )
            for controller in _CONTROLLERS
        }
        for number, world in ((number, _world(number)) for number in range(worlds))
    }


def whole_transferability(bundle: Path, worlds: int = 3) -> dict[str, Scenario]:
    """E1 for whole robots, which stand on pads with room between them. Raises BundleError.

    Their receivers, and the wind, are the same in all worlds.
    """
    pads_m = _pairs(pads_of(bundle))
    return {
        f"world {number}": Scenario(
            robots=FIELD_SET_UP.robots,
            seed=_world(0).seed,
            features=world.features,
            starts_m=pads_m,
            duration_s=SNAPSHOTS_S[-1],
        )
        for number, world in ((number, _world(number)) for number in range(worlds))
    }


def beside(record: FlightRecord) -> dict[str, Scenario]:
    """E1 for a logged flight: the baselines over its world, from where its robots began.

    They fly at the field's scale of speeds. Nobody is there if its world is not, or nobody began.
    """
    starts_m = tuple(record.places_at(0.0).values())
    if record.coverage is None or not record.coverage.features or not starts_m:
        return {}
    coverage = record.coverage
    scale = replace(FIELD_SCALE, env_scale=coverage.cells_per_m)
    return {
        name: Scenario(
            controller=name,
            robots=len(starts_m),
            features=coverage.features,
            starts_m=starts_m,
            world_size=len(coverage.importance),
            scale=scale,
            duration_s=record.duration_s,
        )
        for name in BASELINES
    }


def pads_of(bundle: Path) -> F64:
    """(N, 2): where whole robots stand, m. Raises BundleError."""
    scenario = Scenario(robots=FIELD_SET_UP.robots, seed=_world(0).seed)
    return Layout(scenario, bundle).pads_m


def whole_repeatability(bundle: Path, trials: int = 3, world: int = 0) -> dict[str, Scenario]:
    """E2 for whole robots, whose receivers, compasses and winds differ by trial.

    Raises BundleError; ValueError if no pads are apart for the receivers of so many trials.
    """
    drawn = _world(world)
    scenarios = [
        Scenario(
            robots=FIELD_SET_UP.robots,
            seed=drawn.seed + trial,
            features=drawn.features,
            duration_s=E2_DURATION_S,
        )
        for trial in range(trials)
    ]
    pads_m = pads_for_all(scenarios, bundle, PLACED_WITHIN_M)
    placed = {}
    for trial, scenario in enumerate(scenarios):
        rng = np.random.default_rng(np.random.SeedSequence([drawn.seed, trial]))
        placed_m = pads_m + _around(rng.uniform(0.0, 1.0, len(pads_m)) ** 0.5, rng)
        placed[f"trial {trial + 1}"] = replace(scenario, starts_m=_pairs(placed_m))
    return placed


def repeatability(trials: int = 3, world: int = 0) -> dict[str, Scenario]:
    """E2: one world again and again, from about the same starts, receivers wrong each time anew."""
    drawn, robots = _world(world), FIELD_SET_UP.robots
    scenarios = {}
    for trial in range(trials):
        rng = np.random.default_rng(np.random.SeedSequence([drawn.seed, trial]))
        placed_m = _starts_m(drawn) + _around(rng.uniform(0.0, 1.0, robots) ** 0.5, rng)
        error_m = _around(rng.uniform(*GPS_ERROR_M, robots) / PLACED_WITHIN_M, rng)
        scenarios[f"trial {trial + 1}"] = Scenario(
            robots=robots,
            seed=drawn.seed + trial,
            features=drawn.features,
            starts_m=_pairs(placed_m),
            position_bias=_pairs(error_m * FIELD_SCALE.env_scale),
            duration_s=E2_DURATION_S,
        )
    return scenarios


def _around(radii: F64, rng: np.random.Generator) -> F64:
    """So many times `PLACED_WITHIN_M`, m, each in a direction of its own."""
    angles = rng.uniform(0.0, 2.0 * np.pi, len(radii))
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    offsets_m: F64 = PLACED_WITHIN_M * radii[:, None] * directions
    return offsets_m


def perturbation(world: int = 0) -> Scenario:
    """E3: at steady state a robot is taken away, and brought back to where it was; three times."""
    drawn = _world(world)
    failures = [
        Failure(robot, from_s, from_s + AWAY_S)
        for robot, from_s in zip(TAKEN, _taken_at_s(), strict=True)
    ]
    return Scenario(
        robots=FIELD_SET_UP.robots,
        seed=drawn.seed,
        features=drawn.features,
        starts_m=_pairs(_starts_m(drawn)),
        duration_s=_E3_DURATION_S,
        failures=tuple(failures),
    )


def whole_perturbation(bundle: Path, world: int = 0) -> Scenario:
    """E3 for whole robots, which pilots fly out of the fence, and back. Raises BundleError.

    Their receivers, and the wind, are the same in all worlds.
    """
    return replace(perturbation(world), seed=_world(0).seed, starts_m=_pairs(pads_of(bundle)))


def _taken_at_s() -> list[float]:
    return [TAKEN_AT_S + number * (AWAY_S + BACK_S) for number in range(len(TAKEN))]


class Absence(NamedTuple):
    """A robot was taken away, and brought back; s."""

    robot: str
    from_s: float
    until_s: float


def absences_of(record: FlightRecord) -> list[Absence]:
    """When pilots had robots, in the mission."""
    piloted = [
        Absence(robot.name, interval.begin_s, min(interval.end_s, record.duration_s))
        for robot in record.robots
        for interval in robot.intervals(record.duration_s)
        if interval.state is FlightState.PILOT and 0.0 <= interval.begin_s < record.duration_s
    ]
    return sorted(piloted, key=lambda absence: absence.from_s)


class Phase(NamedTuple):
    """Of E3: a robot is away, or back; the costs are over that at the start.

    `settled_s` is how long after the phase began the cost last was further than 5 % from what it
    came to at its end.
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
    """E3's flight, at times (T,), s: `speed_m_s` and `neighbours` (T, N), NaN of who is away."""

    record: FlightRecord
    absences: Sequence[Absence]
    time_s: F64
    speed_m_s: F64
    neighbours: F64
    phases: tuple[Phase, ...]


def perturbed(flight: SimulatedFlight) -> PerturbedFlight:
    """What a flight of `perturbation` says."""
    scenario = flight.scenario
    taken = [Absence(str(f.robot), f.from_s, f.until_s) for f in scenario.failures]
    range_m = flight.perception.communication_range / scenario.scale.env_scale
    return perturbed_by(flight.record, taken, range_m)


def perturbed_by(
    record: FlightRecord, absences: Sequence[Absence], range_m: float
) -> PerturbedFlight:
    """What a flight says in which robots were away, one after another.

    Neighbours are those within `range_m`. Raises ValueError if nobody was.
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
            # Across a gap it is on the straight way.
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
    """None if it was too short for a cost."""
    times_s, cost = record.curve_time_s, record.normalized
    before, inside = cost[times_s < from_s], (times_s >= from_s) & (times_s < until_s)
    if not inside.any() or not len(before):
        return None
    its_s, its = times_s[inside], cost[inside]
    off = np.flatnonzero(np.abs(its / its[-1] - 1.0) > _SETTLED)
    return Phase(
        robot=robot,
        away=away,
        from_s=from_s,
        until_s=until_s,
        cost_before=float(before[-1]),
        cost_worst=float(its.max()),
        cost_end=float(its[-1]),
        settled_s=float(its_s[off[-1]] - from_s) if len(off) else 0.0,
    )


def looked_at_from_s(trials: Mapping[str, FlightRecord]) -> dict[str, float]:
    """When E2 begins to look at each trial, by name; s, in the trial's own time.

    That is the takeoff command, or for all trials the mission's start, 0, if one of them has none,
    as points have not, or had it earlier than E2 looks.
    """
    found_s = {name: _takeoff_s(record) for name, record in trials.items()}
    if any(not -E2_DURATION_S < at_s <= 0.0 for at_s in found_s.values()):
        return dict.fromkeys(trials, 0.0)
    return found_s


def _takeoff_s(record: FlightRecord) -> float:
    """When the first robot armed, which is what a takeoff command makes of it; NaN if none did."""
    armed_s = [
        time_s
        for robot in record.robots
        for time_s, said in zip(robot.time_s.tolist(), robot.said, strict=False)
        if said.state is FlightState.ARMING
    ]
    return min(armed_s, default=math.nan)


def looked_at(record: FlightRecord, from_s: float) -> FlightRecord:
    """The `E2_DURATION_S` of a trial from a time on, or as much as there is; times count from it.

    Before the mission robots count for the cost where they stand, too.
    """
    end_s = min(E2_DURATION_S, record.duration_s - from_s)
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


def true_curve(record: FlightRecord) -> F64:
    """(C,): the cost for where the robots truly were, over the first; NaN where it is not known."""
    points = not any(robot.said for robot in record.robots)
    return record.normalized if points else record.normalized_true


def curves_json(records: Mapping[str, FlightRecord]) -> dict[str, Any]:
    """Of each flight, by name: its cost and its true cost over those at the start.

    A true cost that is not known is None. The positions are of who was in the air in the end, by
    robot, as the record has them.
    """
    return {
        name: {
            "time_s": record.curve_time_s.tolist(),
            "normalized_cost": record.normalized.tolist(),
            "normalized_true_cost": [_known(cost) for cost in true_curve(record).tolist()],
            "final": float(record.normalized[-1]),
            "final_true": _known(true_curve(record)[-1]),
            "final_positions_m": record.places_at(record.curve_time_s[-1]),
        }
        for name, record in records.items()
    }


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def curves_csv(records: Mapping[str, FlightRecord]) -> list[list[object]]:
    """A heading, and a row for each flight and time; a true cost that is not known is empty."""
    rows: list[list[object]] = [["flight", "time_s", "cost_over_first", "true_cost_over_first"]]
    for name, told in curves_json(records).items():
        curves = (told["time_s"], told["normalized_cost"], told["normalized_true_cost"])
        rows += [[name, *row] for row in zip(*curves, strict=True)]
    return rows


def spread_of(records: Mapping[str, FlightRecord]) -> dict[str, Any]:
    """Of E2's trials: how the costs at the end of the shortest, and the places there, differ.

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
