"""Many flights of many faults: over all cores or a Ray cluster; what was flown is kept on disk.

A campaign that was killed goes on where it was: each flight's outcome is a line of `flights.jsonl`,
below one that says what flew. Another version of the code, or another bundle, begins anew; and what
ended early is flown again.
"""

from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import edge
import lpac
from edge.core.logger import show
from edge.core.part import PartError
from edge.policy.bundle import load_bundle
from lpac.sim.drill.bounds import Figure, judge
from lpac.sim.drill.faults import FAULTS, Fault
from lpac.sim.drill.field import DrilledRobots
from lpac.sim.drill.simulated import SimulatedDrill
from lpac.sim.drill.truth import FlightTruth
from lpac.sim.kept import KeptOutcomes, code_digest
from lpac.sim.sitl.build import build_digest

_FLIGHTS = "flights.jsonl"
# Two ticks of control that a robot left out in a flight, or as much of the vehicles' time.
LATE_S = 0.25


class FlightTask(NamedTuple):
    """One flight to be flown: all of it follows from this."""

    fault: str
    seed: int
    drilled: DrilledRobots


@dataclass(frozen=True, slots=True)
class FlightOutcome:
    """What came of one flight. `error` is what ended it early, such as a defect; else "".

    `late_s` is how far the machine was behind real time, if it was flown in that.
    """

    fault: str
    seed: int
    figures: tuple[Figure, ...]
    error: str = ""
    late_s: float = 0.0

    @property
    def broken(self) -> tuple[Figure, ...]:
        """The promises that did not hold."""
        return tuple(figure for figure in self.figures if figure.broken)

    @property
    def held(self) -> bool:
        """Whether all promises held."""
        return not self.error and not self.broken


# Flies them all; outcomes as they come. On the simulated clock, `fly_order` over a `Pool`.
Flown = Callable[[Sequence[FlightTask]], Generator[FlightOutcome, None, None]]


def outcome_of(fault: Fault, seed: int, flown: Callable[[], FlightTruth]) -> FlightOutcome:
    """Fly and judge. What raises is an outcome, too: no other flight is lost for it.

    Limits are the same in real time. So what breaks one while the machine is late is not judged.
    """
    try:
        truth = flown()
        figures = judge(fault.judged_by, truth)
    except PartError as error:
        return FlightOutcome(fault.name, seed, (), str(error))
    except Exception as error:
        return FlightOutcome(fault.name, seed, (), f"{type(error).__name__}: {error}")
    unjudged = ""
    if truth.late_s > LATE_S and any(figure.broken for figure in figures):
        broken = ", ".join(figure.name for figure in figures if figure.broken)
        unjudged = f"not judged ({broken}): this machine was {truth.late_s:.1f} s behind real time"
    return FlightOutcome(fault.name, seed, figures, unjudged, truth.late_s)


def fly_order(order: FlightTask) -> FlightOutcome:
    """One flight on the simulated clock, in whatever process this is."""
    fault, drill = FAULTS[order.fault], _drill(order.drilled)
    return outcome_of(fault, order.seed, lambda: drill.fly(fault, order.seed))


@cache
def _drill(drilled: DrilledRobots) -> SimulatedDrill:
    # Thousands of flights say more than anybody reads.
    show("error")
    return SimulatedDrill(drilled)


class Campaign:
    """The flights of one set-up, whose outcomes are in `folder`."""

    def __init__(
        self, folder: Path, vehicle: str, drilled: DrilledRobots, px4_build: Path | None = None
    ) -> None:
        """Raises BundleError, OSError."""
        self._drilled = drilled
        flown_by = {
            "vehicle": vehicle, **asdict(drilled), "bundle": load_bundle(drilled.bundle).id,
            "code": code_digest(edge, lpac), "px4": px4_build and build_digest(px4_build),
        }  # fmt: skip
        self._kept = KeptOutcomes(folder / _FLIGHTS, flown_by)
        outcomes = map(_outcome, self._kept.lines)
        self.outcomes = {(o.fault, o.seed): o for o in outcomes if not o.error}

    def fly(
        self, faults: Iterable[Fault], seeds: Iterable[int], flown: Flown
    ) -> Generator[FlightOutcome, None, None]:
        """Fly what was not flown yet, and give all outcomes asked for: first those that were."""
        faults = list(faults)
        # Flights of a seed, and of the same settings, share their begin.
        wanted = [
            (fault, seed)
            for seed in seeds
            for fault in sorted(faults, key=lambda fault: (fault.exact, fault.settings))
        ]
        kept = [key for fault, seed in wanted if (key := (fault.name, seed)) in self.outcomes]
        yield from (self.outcomes[key] for key in kept)
        orders = [
            FlightTask(fault.name, seed, self._drilled)
            for fault, seed in wanted
            if (fault.name, seed) not in self.outcomes
        ]
        if not orders:
            return
        with closing(flown(orders)) as outcomes:
            for outcome in outcomes:
                self.outcomes[outcome.fault, outcome.seed] = outcome
                self._kept.add(asdict(outcome))
                yield outcome


def _outcome(read: Mapping[str, Any]) -> FlightOutcome:
    figures = tuple(Figure(*figure) for figure in read["figures"])
    return FlightOutcome(**{**read, "figures": figures})
