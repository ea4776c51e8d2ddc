"""Flights of a study: planned, flown in groups, and stored with their outcomes."""

import hashlib
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Generic, NamedTuple

import msgspec
import numpy as np

import edge
import lpac
from edge.policy.bundle import Bundle, BundleError
from lpac.analysis.flight import FlightRecord
from lpac.sim.baselines import BaselineName
from lpac.sim.cores import Outcome, Pool, in_this_process
from lpac.sim.engines import (
    IN_REAL_TIME,
    Engine,
    EngineName,
    engine_of,
    loaded_bundle,
    require_flown,
)
from lpac.sim.kept import KeptOutcomes, code_digest
from lpac.sim.points import cost_times_s
from lpac.sim.scenario import Scenario
from lpac.sim.sitl.build import build_digest

POLICY = "lpac"
CLAIRVOYANT: BaselineName = "clairvoyant-cvt"
# Larger batches of the simulator are no faster.
_ROBOTS_TOGETHER = 80
_FLIGHTS = "flights.jsonl"


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedFlight:
    """A scenario, its engine, and the bundle.

    `bundle` is the path of the flown bundle, or of the one that gives a baseline its sizes of
    sensor and local map; `flown_by` is its id, or these sizes. `px4_build` is PX4's build folder.
    """

    scenario: Scenario
    bundle: str
    flown_by: str
    engine: EngineName = "point"
    px4_build: str = ""

    def flown_on(self) -> Engine:
        """The engine. Raises ValueError for PX4 without a build folder."""
        return engine_of(self.engine, Path(self.px4_build) if self.px4_build else None)

    @property
    def key(self) -> str:
        """Identifies the flight, independent of the paths of bundle and PX4."""
        px4 = _px4_digest(self.px4_build) if self.engine == "px4" and self.px4_build else ""
        text = repr((self.engine, self.flown_by, px4, self.scenario))
        return hashlib.sha256(text.encode()).hexdigest()


class CostCurve(NamedTuple):
    """A cost (C,) at times (C,), s: J of the present robots, in model units, or a task's own.

    `lloyd` is the best result of ten runs of Lloyd's algorithm, which know the world, from the same
    starts; None except for clairvoyant flights.
    """

    time_s: tuple[float, ...]
    cost: tuple[float, ...]
    lloyd: float | None = None


# Flights of one batch of the simulator, or a single other flight.
FlightGroup = tuple[PlannedFlight, ...]
# Flies a group, in any process, and returns the outcome of each flight.
FlyGroup = Callable[[FlightGroup], list[tuple[PlannedFlight, Outcome]]]


def task_of(bundle: Bundle) -> str:
    """Properties that policies must share to be compared. Raises BundleError without perception."""
    perception, training = bundle.manifest.perception, bundle.manifest.training
    if perception is None:
        raise BundleError(f"bundle {bundle.manifest.name!r} has no perception: it cannot fly")
    return (
        f"sensor {perception.sensor_size}, speed {training.max_speed:g}, "
        f"features cut at {training.idf_truncation:g}, scaled to {training.idf_norm:g}"
    )


def sizes_of(bundle: Bundle) -> str:
    """Properties that baselines take from a bundle. Raises BundleError without perception."""
    task, perception = task_of(bundle), bundle.manifest.perception
    assert perception is not None
    unseen = perception.unknown_importance
    return f"local map {perception.local_map_size}, unseen {unseen:g}, {task}"


def groups_of(flights: Iterable[PlannedFlight]) -> list[FlightGroup]:
    """Group the flights, roughly in their order."""
    alike: dict[tuple[str, int], list[PlannedFlight]] = {}
    groups: list[FlightGroup] = []
    for flight in flights:
        robots = flight.scenario.robots
        if flight.scenario.controller != POLICY or flight.engine != "point":
            groups.append((flight,))
            continue
        waiting = alike.setdefault((flight.bundle, robots), [])
        waiting.append(flight)
        if len(waiting) * robots >= _ROBOTS_TOGETHER:
            groups.append(tuple(waiting))
            waiting.clear()
    return [*groups, *(tuple(waiting) for waiting in alike.values() if waiting)]


def _robot_seconds(group: FlightGroup) -> float:
    return sum(flight.scenario.robots * flight.scenario.duration_s for flight in group)


def require_planned(flight: PlannedFlight) -> None:
    """Raise ValueError if the bundle at its path is not the planned one."""
    if loaded_bundle(flight.bundle).id != flight.flown_by:
        raise ValueError(f"{flight.bundle}: differs from the planned bundle")


def records_of(
    group: FlightGroup, logs: Path | None = None
) -> list[tuple[PlannedFlight, FlightRecord]]:
    """Fly a group, in any process; files of programs are stored in a folder below `logs`.

    Raises BundleError, ValueError, OSError, and for programs in real time the errors of `lpac sim`.
    """
    first = group[0]
    if first.scenario.controller == POLICY:
        require_planned(first)
    kept = logs / f"flight-{first.key[:8]}" if logs and first.engine in IN_REAL_TIME else None
    flown = first.flown_on().fly([flight.scenario for flight in group], Path(first.bundle), kept)
    for record in flown:
        require_flown(record)
    return list(zip(group, flown, strict=True))


def curves_of(group: FlightGroup) -> list[tuple[PlannedFlight, CostCurve]]:
    """Fly a group as `records_of` does, and return only the costs."""
    return [(flight, curve_of(flight, record)) for flight, record in records_of(group)]


def curve_of(flight: PlannedFlight, record: FlightRecord) -> CostCurve:
    """Cost over a flight, at true positions."""
    time_s = cost_times_s(flight.scenario.duration_s)
    true_cost = record.cost if record.of_points else record.true_cost
    cost = np.interp(time_s, record.curve_time_s, true_cost)
    lloyd = record.lloyd if flight.scenario.controller == CLAIRVOYANT else None
    return CostCurve(tuple(time_s.tolist()), tuple(cost.tolist()), lloyd)


def fly_all(
    do: FlyGroup[Outcome],
    flights: Sequence[PlannedFlight],
    pool: Pool,
    in_real_time: Pool = in_this_process,
) -> Generator[tuple[PlannedFlight, Outcome], None, None]:
    """Fly all groups; yields each flight's outcome.

    The largest groups begin first, so that no core idles long at the end. Flights in real time use
    their own pool, after all others.
    """
    groups: dict[bool, list[FlightGroup]] = {False: [], True: []}
    for group in sorted(groups_of(flights), key=_robot_seconds, reverse=True):
        groups[group[0].engine in IN_REAL_TIME].append(group)
    for group_pool, members in ((pool, groups[False]), (in_real_time, groups[True])):
        if members:
            with closing(group_pool(do, members)) as flown:
                yield from chain.from_iterable(flown)


class KeptFlights(Generic[Outcome]):
    """Outcomes of flights, stored in a folder and reused."""

    def __init__(
        self,
        folder: Path,
        kind: type[Outcome],
        is_kept: Callable[[Outcome], bool] = lambda _: True,
    ) -> None:
        """`kind` is the outcomes' named tuple; a folder has one kind only.

        Outcomes that fail `is_kept` are not stored. Raises OSError.
        """
        self._is_kept = is_kept
        self._kept = KeptOutcomes(folder / _FLIGHTS, {"code": code_digest(edge, lpac)})
        self._outcomes = {
            line["flight"]: msgspec.convert(line["outcome"], kind) for line in self._kept.lines
        }

    def known(self, flights: Iterable[PlannedFlight]) -> dict[PlannedFlight, Outcome]:
        """Stored outcomes of these flights."""
        return {each: self._outcomes[each.key] for each in flights if each.key in self._outcomes}

    def keep(self, flight: PlannedFlight, outcome: Outcome) -> None:
        """Store an outcome. Raises OSError."""
        if self._is_kept(outcome) and flight.key not in self._outcomes:
            self._outcomes[flight.key] = outcome
            line = {"flight": flight.key, "fault": flight.scenario.fault}
            self._kept.add({**line, "seed": flight.scenario.seed, "outcome": outcome})

    def fly(
        self,
        do: FlyGroup[Outcome],
        flights: Sequence[PlannedFlight],
        pool: Pool,
        in_real_time: Pool = in_this_process,
    ) -> Generator[tuple[PlannedFlight, Outcome], None, None]:
        """Yield stored outcomes first, then those of the other flights as they end."""
        known = self.known(flights)
        yield from known.items()
        missing = [flight for flight in flights if flight not in known]
        with closing(fly_all(do, missing, pool, in_real_time)) as flown:
            for flight, outcome in flown:
                self.keep(flight, outcome)
                yield flight, outcome


@cache
def _px4_digest(build: str) -> str:
    return build_digest(Path(build))
