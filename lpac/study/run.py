"""Studies, flown."""

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

Tell = Callable[[int, int], object]


class Flown(NamedTuple):
    """Of a study, under each condition each method's result, and the records if it needs them."""

    results: dict[Condition, list[MethodResult]]
    records: dict[PlannedFlight, FlightRecord]


def run(
    study: Study,
    pool: Pool = in_this_process,
    *,
    folder: Path | None = None,
    tell: Tell = lambda *_: None,
) -> dict[Condition, list[MethodResult]]:
    """Fly all of it: under each condition each method's result, in the study's order.

    With `over_cores` as `pool` all cores fly; a script must then begin what it does below
    `if __name__ == "__main__":`. Flights in real time go one after another, whatever the pool. A
    `folder` keeps what was flown: whoever asks again, of this code, waits for the rest only. `tell`
    gets how many flights are done, and of how many.

    Raises BundleError, ValueError, and OSError if the folder cannot be written.
    """
    flights = study.flights()
    curves: dict[PlannedFlight, CostCurve] = {}
    with closing(_flown(flights, frozenset(), pool, folder)) as flown:
        for flight, (curve, _) in flown:
            curves[flight] = curve
            tell(len(curves), len(flights))
    return results_of(study, curves)


def run_together(
    studies: Mapping[str, Study], pool: Pool, folder: Path, tell: Tell
) -> Iterator[tuple[str, Flown]]:
    """As `run`, of several studies: each, by its name, once all of it is flown.

    What two of them fly is flown once, and nobody waits for one before the next is begun. With the
    record of each flight if a study's figures are of these. Records are not kept: they are flown
    again. Programs in real time leave their logs in `folder`.
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
            tell(len(curves), len(flights))
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
    """Each flight as it comes, those that are `whole` with their records."""
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
    """Fly them, in whatever process this is, which also computes the costs."""
    flown = records_of(group, logs if group[0] in whole else None)
    return [
        (flight, _Outcome(curve_of(flight, record), record if flight in whole else None))
        for flight, record in flown
    ]
