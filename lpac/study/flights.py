"""The flights of a study: planned, flown in groups, and what came of them kept on disk."""

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
    """A scenario, the engine that flies it, and the bundle.

    `bundle` is the path of the one that flies, or that gives a baseline the sizes of sensor and
    local map; `flown_by` is its id, or says these sizes. PX4s are those of `px4_build`.
    """

    scenario: Scenario
    bundle: str
    flown_by: str
    engine: EngineName = "point"
    px4_build: str = ""

    def flown_on(self) -> Engine:
        """The engine itself. Raises ValueError for PX4s without their build."""
        return engine_of(self.engine, Path(self.px4_build) if self.px4_build else None)

    @property
    def key(self) -> str:
        """What tells it from all other flights, wherever the bundle and PX4 lie."""
        px4 = _px4_digest(self.px4_build) if self.engine == "px4" and self.px4_build else ""
        told = repr((self.engine, self.flown_by, px4, self.scenario))
        return hashlib.sha256(told.encode()).hexdigest()


class CostCurve(NamedTuple):
    """A cost (C,) at times (C,), s.

    That is J, the coverage cost in model units of the robots that are left, or another task's.
    `lloyd` is what the best of ten runs of Lloyd's algorithm, which know the world, come to from
    the same starts: None but for flights of the clairvoyant.
    """

    time_s: tuple[float, ...]
    cost: tuple[float, ...]
    lloyd: float | None = None


# Flights that go together: those of one batch of the simulator, or one other.
FlightGroup = tuple[PlannedFlight, ...]
# Flies a group, in whatever process it is, and says what came of each flight.
FlyGroup = Callable[[FlightGroup], list[tuple[PlannedFlight, Outcome]]]


def task_of(bundle: Bundle) -> str:
    """What policies must have in common to be compared. Raises BundleError without perception."""
    perception, training = bundle.manifest.perception, bundle.manifest.training
    if perception is None:
        raise BundleError(f"bundle {bundle.manifest.name!r} has no perception: it cannot fly")
    return (
        f"sensor {perception.sensor_size}, speed {training.max_speed:g}, "
        f"features cut at {training.idf_truncation:g}, scaled to {training.idf_norm:g}"
    )


def sizes_of(bundle: Bundle) -> str:
    """What baselines take from a bundle. Raises BundleError without perception."""
    task, perception = task_of(bundle), bundle.manifest.perception
    assert perception is not None
    unseen = perception.unknown_importance
    return f"local map {perception.local_map_size}, unseen {unseen:g}, {task}"


def groups_of(flights: Iterable[PlannedFlight]) -> list[FlightGroup]:
    """The flights in groups that go together, in about their order."""
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
    """Raise ValueError if another bundle is at its path than when the flight was planned."""
    if loaded_bundle(flight.bundle).id != flight.flown_by:
        raise ValueError(f"{flight.bundle}: is another bundle by now, or on this machine")


def records_of(
    group: FlightGroup, logs: Path | None = None
) -> list[tuple[PlannedFlight, FlightRecord]]:
    """Fly them, in whatever process this is; what programs leave is kept in a folder in `logs`.

    Raises BundleError, ValueError, OSError, and what `lpac sim` does of programs in real time.
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
    """Fly them as `records_of` does, and keep no more than the costs."""
    return [(flight, curve_of(flight, record)) for flight, record in records_of(group)]


def curve_of(flight: PlannedFlight, record: FlightRecord) -> CostCurve:
    """The cost over a flight, of where robots and vehicles truly are."""
    time_s = cost_times_s(flight.scenario.duration_s)
    true_cost = record.true_cost if record.truth else record.cost
    cost = np.interp(time_s, record.curve_time_s, true_cost)
    lloyd = record.lloyd if flight.scenario.controller == CLAIRVOYANT else None
    return CostCurve(tuple(time_s.tolist()), tuple(cost.tolist()), lloyd)


def fly_all(
    do: FlyGroup[Outcome],
    flights: Sequence[PlannedFlight],
    pool: Pool,
    in_real_time: Pool = in_this_process,
) -> Generator[tuple[PlannedFlight, Outcome], None, None]:
    """Each flight as it is done, with what `do` makes of its group.

    The largest groups are begun first, so that in the end no core waits long for another. Flights
    in real time have a pool of their own, and nothing of the other beside them.
    """
    groups: dict[bool, list[FlightGroup]] = {False: [], True: []}
    for group in sorted(groups_of(flights), key=_robot_seconds, reverse=True):
        groups[group[0].engine in IN_REAL_TIME].append(group)
    for its_pool, its in ((pool, groups[False]), (in_real_time, groups[True])):
        if its:
            with closing(its_pool(do, its)) as flown:
                yield from chain.from_iterable(flown)


class KeptFlights(Generic[Outcome]):
    """What came of flights, in a folder: who asks again for one that was flown there has it."""

    def __init__(
        self,
        folder: Path,
        kind: type[Outcome],
        is_kept: Callable[[Outcome], bool] = lambda _: True,
    ) -> None:
        """Outcomes are named tuples of this kind: a folder has those of one alone.

        What `is_kept` does not want is flown again. Raises OSError.
        """
        self._is_kept = is_kept
        self._kept = KeptOutcomes(folder / _FLIGHTS, {"code": code_digest(edge, lpac)})
        self._outcomes = {
            line["flight"]: msgspec.convert(line["outcome"], kind) for line in self._kept.lines
        }

    def known(self, flights: Iterable[PlannedFlight]) -> dict[PlannedFlight, Outcome]:
        """Those of them that were flown before."""
        return {each: self._outcomes[each.key] for each in flights if each.key in self._outcomes}

    def keep(self, flight: PlannedFlight, outcome: Outcome) -> None:
        """What came of one more. Raises OSError."""
        if self._is_kept(outcome) and flight.key not in self._outcomes:
            self._outcomes[flight.key] = outcome
            told = {"flight": flight.key, "fault": flight.scenario.fault}
            self._kept.add({**told, "seed": flight.scenario.seed, "outcome": outcome})

    def fly(
        self,
        do: FlyGroup[Outcome],
        flights: Sequence[PlannedFlight],
        pool: Pool,
        in_real_time: Pool = in_this_process,
    ) -> Generator[tuple[PlannedFlight, Outcome], None, None]:
        """All of them: first what was flown before, and then the others as they come."""
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
