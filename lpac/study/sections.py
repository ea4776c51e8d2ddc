"""Sections of a report on whole flights: figures, a table, and numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from edge.core import F64
from edge.core.counted import counted
from lpac.analysis import figures as flight_figures
from lpac.analysis import style
from lpac.analysis.flight import FlightRecord
from lpac.analysis.statistics import finite
from lpac.study import figures
from lpac.study.perturbation import PerturbedFlight
from lpac.study.repeatability import evaluated_part, evaluation_start_s, not_compared, spread_of
from lpac.study.report import Picture, Report, Table, write_csv

_COSTS = (
    "Costs are relative to the initial cost. They are at the true positions of points; at the "
    "estimated positions of whole robots and in logs, and at true ones where these are known."
)
_SNAPSHOTS_S = (0.0, 0.25, 0.5, 1.0)


@dataclass(frozen=True, slots=True)
class Section:
    """Section of a report on flights: `data` is for the JSON, `rows` for the CSV, heading first."""

    data: Mapping[str, Any]
    tables: Sequence[Table]
    figures: Sequence[Picture]
    rows: Sequence[Sequence[object]]

    def report(self, name: str, title: str, flown: str, made_by: Mapping[str, str]) -> Report:
        """Report with this section only; `flown` and `made_by` are `Report`'s."""
        return Report(
            name=name, title=title, text=flown, data=self.data, rows=self.rows,
            tables=self.tables, figures=self.figures, flown=flown, made_by=made_by,
        )  # fmt: skip


def snapshots(records: Mapping[str, Mapping[str, FlightRecord]], folder: Path) -> Section:
    """Flights by world and method, of which the first method's are drawn. Raises OSError."""
    first = {world: next(iter(of_world.values())) for world, of_world in records.items()}
    duration_s = min(record.duration_s for record in first.values())
    times_s = [share * duration_s for share in _SNAPSHOTS_S]
    style.save(flight_figures.snapshots_of_several(first, times_s), folder / "snapshots")
    style.save(figures.costs_by_world(records), folder / "costs")
    names = list(dict.fromkeys(name for of_world in records.values() for name in of_world))
    rows = [
        [world, *(_final(of_world[name]) if name in of_world else "" for name in names)]
        for world, of_world in records.items()
    ]
    named = {
        f"{world}, {name}": record
        for world, of_world in records.items()
        for name, record in of_world.items()
    }
    return Section(
        {"flights": {world: curves_json(of_world) for world, of_world in records.items()}},
        [Table(["", *names], rows, "World by world",
               f"The final cost, and in brackets that at the true positions. {_COSTS}")],
        [Picture("snapshots.png", "snapshots"), Picture("costs.png", "costs")],
        curves_csv(named),
    )  # fmt: skip


def repeatability(trials: Mapping[str, FlightRecord], folder: Path, duration_s: float) -> Section:
    """Compare trials, by name, over `duration_s`.

    Raises OSError; ValueError if no robot was in the air at the end of all trials.
    """
    from_s = evaluation_start_s(trials, duration_s)
    parts = {name: evaluated_part(trials[name], from_s[name], duration_s) for name in trials}
    first = next(iter(trials.values()))
    # All trials share one world, which is drawn below the end positions.
    records = [replace(each, name=name, coverage=first.coverage) for name, each in parts.items()]
    spread = spread_of(parts)
    style.save(flight_figures.repeatability(records), folder / "repeatability")
    rows = [
        [name, _final(record), f"{0.0 - from_s[name]:.0f} s", _final(trials[name])]
        for name, record in parts.items()
    ]
    headings = ["", f"cost after {spread['end_s']:.0f} s (true)", "mission began after",
                "final / initial cost of the mission"]  # fmt: skip
    begins = "Times count from the mission's start: points have no takeoff, and logs may have none "
    begins += f"within the {duration_s:g} s before."
    if any(from_s.values()):
        begins = (
            "Times count from the takeoff command. Robots take off one after another; until the "
            "mission begins, robots on their pads count where they stand."
        )
    note = (
        f"{_COSTS} {begins}\nCosts after {spread['end_s']:.0f} s: mean "
        f"{spread['final_mean']:.3f}, standard deviation {spread['final_deviation']:.3f}; before "
        f"that the deviation is {spread['largest_deviation_in_flight']:.3f} at most. On average a "
        f"robot ends {spread['mean_scatter_of_ends_m']:.2f} m from the mean of its end positions. "
        f"{' '.join(not_compared(spread))}"
    )
    return Section(
        {
            "trials": curves_json(parts),
            "mission_from_s": {name: 0.0 - at_s for name, at_s in from_s.items()},
            "mission_final": {name: float(trials[name].normalized[-1]) for name in trials},
            "looked_at_s": duration_s,
            "spread": spread,
        },
        [Table(headings, rows, "Trial by trial", note)],
        [Picture("repeatability.png", "cost of all trials, and where robots end")],
        curves_csv(parts),
    )


def perturbation(flight: PerturbedFlight, folder: Path) -> Section:
    """Section on a flight from which robots are removed. Raises OSError."""
    style.save(figures.perturbation(flight), folder / "perturbation")
    write_csv(curves_csv({"flight": flight.record}), folder / "cost.csv")
    rows = [
        [
            f"robot {phase.robot} {'away' if phase.away else 'back'}",
            f"{phase.from_s:.0f} to {phase.until_s:.0f} s",
            f"{phase.cost_before:.3f}", f"{phase.cost_worst:.3f}", f"{phase.cost_end:.3f}",
            f"{phase.settled_s:.0f} s",
        ]
        for phase in flight.phases
    ]  # fmt: skip
    headings = ["", "when", "cost before", "worst", "at the end", "settled after"]
    note = (
        f"Robots are removed {counted(len(flight.absences), 'time')}. {_COSTS} The true cost is "
        "the thin line, and is not in this table. Settled: from then on the cost stayed within 5 % "
        "of its value at the next event, or at the end of the flight. `cost.csv` has the cost over "
        "time; the other CSV has speeds and neighbours."
    )
    csv_rows: list[list[object]] = [["time_s", "robot", "speed_m_s", "neighbours"]]
    for time_s, speeds, neighbours in zip(
        flight.time_s.tolist(), flight.speed_m_s, flight.neighbours, strict=True
    ):
        states = zip(flight.record.robots, speeds.tolist(), neighbours.tolist(), strict=True)
        csv_rows += [[time_s, robot.name, speed, count] for robot, speed, count in states]
    return Section(
        {
            "flight": curves_json({"": flight.record})[""],
            "phases": [phase._asdict() for phase in flight.phases],
            "neighbours": {
                "mean": float(np.nanmean(flight.neighbours)),
                "others": len(flight.record.robots) - 1,
            },
        },
        [Table(headings, rows, "Robots away, and back", note)],
        [Picture("perturbation.png", "cost, neighbours and speeds")],
        csv_rows,
    )


def _final(record: FlightRecord) -> str:
    """Final cost, and in brackets that at true positions if known."""
    curve = curves_json({"": record})[""]
    known = record.truth and curve["final_true"] is not None
    return f"{curve['final']:.3f}" + (f" ({curve['final_true']:.3f})" if known else "")


def true_curve(record: FlightRecord) -> F64:
    """Cost (C,) at true positions over the initial cost; NaN where unknown."""
    return record.normalized if record.of_points else record.normalized_true


def curves_json(records: Mapping[str, FlightRecord]) -> dict[str, Any]:
    """Costs and true costs of each flight, by name, over the initial ones; None where unknown.

    Final positions are by robot, of the robots in the air at the end, as in the record.
    """
    return {
        name: {
            "time_s": record.curve_time_s.tolist(),
            "normalized_cost": record.normalized.tolist(),
            "normalized_true_cost": [finite(cost) for cost in true_curve(record).tolist()],
            "final": float(record.normalized[-1]),
            "final_true": finite(true_curve(record)[-1]),
            "final_positions_m": record.places_at(record.curve_time_s[-1]),
        }
        for name, record in records.items()
    }


def curves_csv(records: Mapping[str, FlightRecord]) -> list[list[object]]:
    """CSV rows: a heading, then one per flight and time. An unknown true cost is empty."""
    rows: list[list[object]] = [["flight", "time_s", "cost_over_first", "true_cost_over_first"]]
    for name, curve in curves_json(records).items():
        curves = (curve["time_s"], curve["normalized_cost"], curve["normalized_true_cost"])
        rows += [[name, *row] for row in zip(*curves, strict=True)]
    return rows
