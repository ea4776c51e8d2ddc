"""Flight of a fault that keeps its logs and a figure."""

import shutil
from collections.abc import Callable
from pathlib import Path

from lpac.analysis.flight import FlightRecord
from lpac.analysis.truth import TRUTH, write_truth
from lpac.sim.drill.faults import Fault
from lpac.sim.drill.figure import write_figure
from lpac.sim.drill.outcome import LATE_S, FlightOutcome, outcome_of

# A promise broken on an overloaded machine proves nothing: fly again.
_TRIES = 3


def fly_logged(fault: Fault, fly: Callable[[], FlightRecord], folder: Path) -> FlightOutcome:
    """Fly, log to a new `folder` and judge; repeat if a promise broke while this machine was late.

    The files of late flights are kept next to `folder`, in NAME-late-1, and so on.
    """

    def fly_once() -> FlightRecord:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        flight = fly()
        write_figure(fault, flight, folder)
        write_truth(
            {i: track.shifted(flight.begin_s) for i, track in enumerate(flight.vehicles)},
            folder / TRUTH,
        )
        return flight

    for number in range(1, _TRIES + 1):
        outcome = outcome_of(fault, fly_once)
        if outcome.held or outcome.late_s <= LATE_S:
            break
        late = folder.with_name(f"{folder.name}-late-{number}")
        shutil.rmtree(late, ignore_errors=True)
        if folder.exists():
            shutil.copytree(folder, late)
    return outcome
