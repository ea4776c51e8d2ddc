"""The outcome of one flight of a fault: what was measured, judged by its bounds."""

from collections.abc import Callable
from typing import NamedTuple

from edge.core.part import PartError
from lpac.analysis.flight import FlightRecord
from lpac.sim.drill.bounds import Figure, judge
from lpac.sim.drill.faults import Fault

# Two ticks of control that a robot left out in a flight, or as much of the vehicles' time.
LATE_S = 0.25


class FlightOutcome(NamedTuple):
    """Judged figures of one flight. `error` says what ended it early, such as a defect; else "".

    `late_s` is how far the machine was behind real time, if it was flown in that.
    """

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


def outcome_of(fault: Fault, flown: Callable[[], FlightRecord]) -> FlightOutcome:
    """Fly and judge. What raises is an outcome, too: no other flight is lost for it.

    Limits are the same in real time. So what breaks one while the machine is late is not judged.
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
