"""What a drill comes to: a table, JSON, and JUnit's XML."""

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple
from xml.etree import ElementTree

from lpac.analysis.statistics import at_most_share
from lpac.sim.drill.bounds import Figure
from lpac.sim.drill.campaign import FlightOutcome
from lpac.sim.drill.faults import FAULTS


class FaultSummary(NamedTuple):
    """All flights of one fault; `worst` has each figure where it came nearest its limit."""

    fault: str
    flights: int
    broken: int
    worst: tuple[Figure, ...]

    @property
    def tightest(self) -> Figure | None:
        """The figure with the least room."""
        return min(self.worst, key=lambda figure: figure.room, default=None)


def summaries(outcomes: Iterable[FlightOutcome]) -> list[FaultSummary]:
    """By fault, in the catalogue's order."""
    by_fault: dict[str, list[FlightOutcome]] = {}
    for outcome in outcomes:
        by_fault.setdefault(outcome.fault, []).append(outcome)
    return [
        FaultSummary(name, len(flown), sum(not outcome.held for outcome in flown), _worst(flown))
        for name in FAULTS
        if (flown := by_fault.get(name))
    ]


def _worst(outcomes: Sequence[FlightOutcome]) -> tuple[Figure, ...]:
    columns = zip(*(outcome.figures for outcome in outcomes if outcome.figures), strict=True)
    return tuple(min(column, key=lambda figure: figure.room) for column in columns)


def shown(figure: Figure) -> str:
    """ "lands 2.4 s (at most 3.3)"."""
    unit = f" {figure.unit}" if figure.unit else ""
    value = f"{figure.value:.3g}" if math.isfinite(figure.value) else "never"
    if figure.value == math.inf and figure.at_least:
        return f"{figure.name}: as wanted"
    how = "at least" if figure.at_least else "at most"
    return f"{figure.name} {value}{unit} ({how} {figure.limit:.3g})"


def flown_again_by(outcome: FlightOutcome, options: str) -> str:
    """The command that flies exactly that flight again; with the drill's further options."""
    return f"lpac drill --fault {outcome.fault} --seed {outcome.seed} {options}"


def as_json(outcomes: Sequence[FlightOutcome], options: str) -> dict[str, Any]:
    """For scripts: each fault with its worst figures, and each flight that broke a promise.

    `options` are the drill's, for `flown_again_by`.
    """
    return {
        "faults": [
            {
                "fault": summary.fault,
                "what": FAULTS[summary.fault].what,
                "promise": FAULTS[summary.fault].promise,
                "uncovered": FAULTS[summary.fault].uncovered,
                "flights": summary.flights,
                "broken": summary.broken,
                "at_most_share": round(at_most_share(summary.flights, summary.broken), 5),
                "worst": [_figure_json(figure) for figure in summary.worst],
            }
            for summary in summaries(outcomes)
        ],
        "broken": [
            {
                "fault": outcome.fault,
                "seed": outcome.seed,
                "error": outcome.error,
                "late_s": round(outcome.late_s, 2),
                "figures": [_figure_json(figure) for figure in outcome.broken],
                "again": flown_again_by(outcome, options),
            }
            for outcome in outcomes
            if not outcome.held
        ],
    }


def _figure_json(figure: Figure) -> dict[str, Any]:
    # JSON has no infinity.
    value = figure.value if math.isfinite(figure.value) else None
    return {**figure._asdict(), "value": value}


def as_junit(outcomes: Sequence[FlightOutcome], options: str) -> bytes:
    """A test suite whose cases are the flights; `options` as of `as_json`."""
    failed = [outcome for outcome in outcomes if not outcome.held]
    suite = ElementTree.Element(
        "testsuite", name="lpac drill", tests=str(len(outcomes)), failures=str(len(failed))
    )
    for outcome in outcomes:
        case = ElementTree.SubElement(
            suite, "testcase", classname=outcome.fault, name=f"seed {outcome.seed}"
        )
        if not outcome.held:
            message = outcome.error or "; ".join(map(shown, outcome.broken))
            failure = ElementTree.SubElement(case, "failure", message=message)
            failure.text = (
                f"promised: {FAULTS[outcome.fault].promise}\n{flown_again_by(outcome, options)}"
            )
    xml: bytes = ElementTree.tostring(suite, encoding="utf-8", xml_declaration=True)
    return xml
