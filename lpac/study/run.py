"""Fly studies, over several cores, and store what was flown."""

from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import NamedTuple

from lpac.analysis.flight import FlightRecord
from lpac.sim.cores import Pool, in_this_process
from lpac.study.flights import (
    CostCurve,
    FlightGroup,
    KeptFlights,
    PlannedFlight,
    curve_of,
    fly_all,
    records_of,
)
from lpac.study.results import MethodResult, results_of
from lpac.study.study import Condition, Study

OnProgress = Callable[[int, int], object]


class Flown(NamedTuple):
    """A study's results by condition and method, and its flights' records if it needs them."""

    results: dict[Condition, list[MethodResult]]
    records: dict[PlannedFlight, FlightRecord]


def run(
    study: Study,
    pool: Pool = in_this_process,
    *,
    folder: Path | None = None,
    on_progress: OnProgress = lambda *_: None,
) -> dict[Condition, list[MethodResult]]:
    """Fly a study; returns each method's result under each condition, in the study's order.

    With `over_cores` as `pool`, all cores fly; a script must then guard its code with
    `if __name__ == "__main__":`. Flights in real time run one after another with any pool. A
    `folder` stores outcomes, so that a repeated run of the same code flies only the rest.
    `on_progress` is called with the numbers of flights done and planned.

    Raises BundleError, ValueError, and OSError if the folder cannot be written.
    """
    flights = study.flights()
    curves: dict[PlannedFlight, CostCurve] = {}
    with closing(_flown(flights, frozenset(), pool, folder)) as flown:
        for flight, (curve, _) in flown:
            curves[flight] = curve
            on_progress(len(curves), len(flights))
    return results_of(study, curves)


def run_together(
    studies: Mapping[str, Study], pool: Pool, folder: Path, on_progress: OnProgress
) -> Iterator[tuple[str, Flown]]:
    """Fly several studies as `run` does; yields each with its name once all its flights are done.

    Flights that studies share are flown once, and no study waits for another. Records are included
    for studies whose figures need them. They are not stored, so these flights are flown again.
    Programs in real time leave their logs in `folder`.
    """
    missing = {name: set(study.flights()) for name, study in studies.items()}
    whole = frozenset(f for name, s in studies.items() if s.needs_records for f in missing[name])
    flights = list(dict.fromkeys(f for study in studies.values() for f in study.flights()))
    curves: dict[PlannedFlight, CostCurve] = {}
    records: dict[PlannedFlight, FlightRecord] = {}
    with closing(_flown(flights, whole, pool, folder)) as flown:
        for flight, (curve, record) in flown:
            curves[flight] = curve
            if record is not None:
                records[flight] = record
            on_progress(len(curves), len(flights))
            for name, study in studies.items():
                if missing[name] == {flight}:
                    own = study.flights() if study.needs_records else ()
                    yield name, Flown(results_of(study, curves), {f: records[f] for f in own})
                missing[name].discard(flight)


class _Outcome(NamedTuple):
    curve: CostCurve
    record: FlightRecord | None


def _flown(
    flights: Sequence[PlannedFlight],
    whole: frozenset[PlannedFlight],
    pool: Pool,
    folder: Path | None,
) -> Generator[tuple[PlannedFlight, _Outcome], None, None]:
    """Yield the outcome of each flight when it ends, with its record if it is in `whole`."""
    kept = KeptFlights(folder, CostCurve) if folder else None
    known = kept.known(flight for flight in flights if flight not in whole) if kept else {}
    for flight, curve in known.items():
        yield flight, _Outcome(curve, None)
    missing = [flight for flight in flights if flight not in known]
    with closing(fly_all(partial(_outcomes_of, whole=whole, logs=folder), missing, pool)) as flown:
        for flight, outcome in flown:
            if kept:
                kept.keep(flight, outcome.curve)
            yield flight, outcome


def _outcomes_of(
    group: FlightGroup, whole: frozenset[PlannedFlight], logs: Path | None
) -> list[tuple[PlannedFlight, _Outcome]]:
    """Fly a group and compute its costs, in any process."""
    flown = records_of(group, logs if group[0] in whole else None)
    return [
        (flight, _Outcome(curve_of(flight, record), record if flight in whole else None))
        for flight, record in flown
    ]
