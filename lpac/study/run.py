"""Studies, flown."""

from collections.abc import Callable, Generator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import NamedTuple

from lpac.analysis.flight import FlightRecord
from lpac.sim.cores import Outcome, Pool, in_this_process
from lpac.study.flights import (
    CostCurve,
    KeptFlights,
    PlannedFlight,
    curve_of,
    curves_of,
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
    keeper = KeptFlights(folder, curves_of, CostCurve) if folder else None
    flown = keeper.fly(flights, pool) if keeper else fly_all(curves_of, flights, pool)
    return results_of(study, _all(flown, len(flights), tell))


def run_with_records(study: Study, pool: Pool, folder: Path, tell: Tell) -> Flown:
    """As `run`, with the record of each flight if the study's figures are of these.

    Records are not kept: they are flown again. Programs in real time leave their logs in `folder`.
    """
    if not study.needs_records:
        return Flown(run(study, pool, folder=folder, tell=tell), {})
    flights = study.flights()
    flown = fly_all(partial(records_of, logs=folder), flights, pool)
    records = _all(flown, len(flights), tell)
    curves = {flight: curve_of(flight, record) for flight, record in records.items()}
    return Flown(results_of(study, curves), records)


def _all(
    flown: Generator[tuple[PlannedFlight, Outcome], None, None], of: int, tell: Tell
) -> dict[PlannedFlight, Outcome]:
    outcomes = {}
    with closing(flown):
        for flight, outcome in flown:
            outcomes[flight] = outcome
            tell(len(outcomes), of)
    return outcomes
