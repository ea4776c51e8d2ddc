"""The outcome of one flight of a fault: its figures, judged by their bounds."""

from collections.abc import Callable
from typing import NamedTuple

from edge.core.part import PartError
from lpac.analysis.flight import FlightRecord
from lpac.sim.drill.bounds import Figure, judge
from lpac.sim.drill.faults import Fault

# Two control ticks that a robot skipped, or as much of the vehicles' time.
LATE_S = 0.25


class FlightOutcome(NamedTuple):
    """Judged figures of one flight; `error` says why it ended early or was not judged, else "".

    `late_s` is how far the machine was behind, of a flight in real time.
    """

    figures: tuple[Figure, ...]
    error: str = ""
    late_s: float = 0.0

    @property
    def broken(self) -> tuple[Figure, ...]:
        """Figures beyond their limits."""
        return tuple(figure for figure in self.figures if figure.broken)

    @property
    def held(self) -> bool:
        """Whether all promises held."""
        return not self.error and not self.broken


def outcome_of(fault: Fault, flown: Callable[[], FlightRecord]) -> FlightOutcome:
    """Fly and judge. An exception is an outcome too, so that other flights go on.

    Limits are the same in real time, so a flight that breaks one while the machine is late is not
    judged.
    """
    try:
        flight = flown()
        figures = judge(fault.judged_by, flight)
    except PartError as error:
        return FlightOutcome((), str(error))
    except Exception as error:
        return FlightOutcome((), f"{type(error).__name__}: {error}")
    late_s, unjudged = flight.fault.late_s, ""
    if late_s > LATE_S and any(figure.broken for figure in figures):
        broken = ", ".join(figure.name for figure in figures if figure.broken)
        unjudged = f"not judged ({broken}): this machine was {late_s:.1f} s behind real time"
    return FlightOutcome(figures, unjudged, late_s)
