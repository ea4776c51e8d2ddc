"""Reports of drills: README.md, CSV, JSON, and JUnit XML for CI."""

import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple
from xml.etree import ElementTree

from edge.core.counted import counted
from lpac.analysis.statistics import at_most_share, finite
from lpac.shipped import SHIPPED_BUNDLE
from lpac.sim.drill.bounds import Figure
from lpac.sim.drill.faults import FAULTS
from lpac.sim.drill.outcome import FlightOutcome
from lpac.sim.scenario import WORLD_SENSOR
from lpac.study.flights import PlannedFlight
from lpac.study.report import Report, Table

Outcomes = Mapping[PlannedFlight, FlightOutcome]


class FaultSummary(NamedTuple):
    """Result of one fault's flights; `worst` has each figure's worst value."""

    fault: str
    flights: int
    broken: int
    worst: tuple[Figure, ...]

    @property
    def tightest(self) -> Figure | None:
        """The figure with the least margin."""
        return min(self.worst, key=lambda figure: figure.room, default=None)


def summaries(outcomes: Outcomes) -> list[FaultSummary]:
    """One summary per fault, in the catalogue's order."""
    by_fault: dict[str, list[FlightOutcome]] = {}
    for flight, outcome in outcomes.items():
        by_fault.setdefault(flight.scenario.fault, []).append(outcome)
    return [
        FaultSummary(name, len(flown), sum(not outcome.held for outcome in flown), _worst(flown))
        for name in FAULTS
        if (flown := by_fault.get(name))
    ]


def _worst(outcomes: Iterable[FlightOutcome]) -> tuple[Figure, ...]:
    columns = zip(*(outcome.figures for outcome in outcomes if outcome.figures), strict=True)
    return tuple(min(column, key=lambda figure: figure.room) for column in columns)


def repeat_command(flight: PlannedFlight) -> str:
    """Shell command that repeats a flight."""
    scenario = flight.scenario
    words = ["lpac", "drill", "--fault", flight.scenario.fault, "--seed", str(scenario.seed)]
    words += ["-n", str(scenario.robots)]
    if flight.bundle != str(SHIPPED_BUNDLE.resolve()):
        words += ["--bundle", flight.bundle]
    if scenario.sensor != WORLD_SENSOR:
        words += ["--sensor", scenario.sensor]
    if flight.engine != "simulated":
        words += ["--vehicle", flight.engine]
    if flight.px4_build:
        words += ["--px4", flight.px4_build]
    return shlex.join(words)


def report_of(outcomes: Outcomes, made_by: Mapping[str, str]) -> Report:
    """Report with the least margin of each fault, and all flights that broke a promise."""
    rows = [
        (
            summary.fault,
            FAULTS[summary.fault].promise,
            f"{summary.flights - summary.broken} of {summary.flights}",
            "" if summary.tightest is None else _shown(summary.tightest),
        )
        for summary in summaries(outcomes)
    ]
    broken = {flight: outcome for flight, outcome in outcomes.items() if not outcome.held}
    share = 100.0 * at_most_share(len(outcomes), len(broken))
    note = [
        f"{len(broken)} of {counted(len(outcomes), 'flight')} broke a promise: at most "
        f"{share:.3g} % in this model, at 95 % confidence"
    ]
    for flight, outcome in broken.items():
        note += [f"{flight.scenario.fault}, seed {flight.scenario.seed}: {_why(outcome)}"]
        note += [f"    {repeat_command(flight)}"]
    first = next(iter(outcomes))
    late_s = max(outcome.late_s for outcome in outcomes.values())
    if first.engine != "simulated":
        note.append(f"this machine was at most {late_s:.1f} s behind real time in a flight")
    return Report(
        name="drill",
        title="Faults in flight",
        text="Each flight injects a fault into a fleet. Promises are judged by the vehicles' true "
        "positions.",
        data=_json(outcomes),
        rows=list(_rows(outcomes)),
        tables=[
            Table(("fault", "promise", "kept", "nearest its limit"), rows, note="\n".join(note))
        ],
        figures=(),
        flown=f"{counted(first.scenario.robots, 'robot')}, {first.engine}",
        made_by=made_by,
    )


def _shown(figure: Figure) -> str:
    """Text such as "lands 2.4 s (at most 3.3)"."""
    unit = f" {figure.unit}" if figure.unit else ""
    value = f"{figure.value:.3g}" if math.isfinite(figure.value) else "never"
    if figure.value == math.inf and figure.at_least:
        return f"{figure.name}: as required"
    how = "at least" if figure.at_least else "at most"
    return f"{figure.name} {value}{unit} ({how} {figure.limit:.3g})"


def _why(outcome: FlightOutcome) -> str:
    return outcome.error or "; ".join(map(_shown, outcome.broken))


def _json(outcomes: Outcomes) -> dict[str, Any]:
    """Content of drill.json: each fault's worst figures, and flights that broke a promise."""
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
                "fault": flight.scenario.fault,
                "seed": flight.scenario.seed,
                "error": outcome.error,
                "late_s": round(outcome.late_s, 2),
                "figures": [_figure_json(figure) for figure in outcome.broken],
                "again": repeat_command(flight),
            }
            for flight, outcome in outcomes.items()
            if not outcome.held
        ],
    }


def _figure_json(figure: Figure) -> dict[str, Any]:
    return {**figure._asdict(), "value": finite(figure.value)}


def _rows(outcomes: Outcomes) -> Iterable[Sequence[object]]:
    yield "fault", "seed", *Figure._fields, "broken"
    for flight, outcome in outcomes.items():
        for figure in outcome.figures:
            yield flight.scenario.fault, flight.scenario.seed, *figure, figure.broken


def as_junit(outcomes: Outcomes) -> bytes:
    """JUnit test suite, as XML, with a case per flight."""
    failed = [outcome for outcome in outcomes.values() if not outcome.held]
    suite = ElementTree.Element(
        "testsuite", name="lpac drill", tests=str(len(outcomes)), failures=str(len(failed))
    )
    for flight, outcome in outcomes.items():
        case = ElementTree.SubElement(
            suite, "testcase", classname=flight.scenario.fault, name=f"seed {flight.scenario.seed}"
        )
        if not outcome.held:
            failure = ElementTree.SubElement(case, "failure", message=_why(outcome))
            failure.text = (
                f"promised: {FAULTS[flight.scenario.fault].promise}\n{repeat_command(flight)}"
            )
    xml: bytes = ElementTree.tostring(suite, encoding="utf-8", xml_declaration=True)
    return xml
