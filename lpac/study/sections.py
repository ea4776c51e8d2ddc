"""Sections of a report on whole flights: each is a figure or two, a table, and numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from edge.core import F64
from lpac.analysis import figures as flight_figures
from lpac.analysis import style
from lpac.analysis.flight import FlightRecord
from lpac.analysis.statistics import finite
from lpac.study import figures
from lpac.study.perturbation import PerturbedFlight
from lpac.study.repeatability import looked_at, looked_at_from_s, spread_of, who_is_missing
from lpac.study.report import Picture, Report, Table, write_csv

_COSTS = (
    "Costs are divided by that at the start: for points, of their true positions; for whole robots "
    "and logs, of estimated positions, and of true ones where those are known."
)
_SNAPSHOTS_S = (0.0, 0.25, 0.5, 1.0)


@dataclass(frozen=True, slots=True)
class Section:
    """Section of a report on flights.

    `data` is for scripts, `rows` are the CSV's, its heading first.
    """

    data: Mapping[str, Any]
    tables: Sequence[Table]
    figures: Sequence[Picture]
    rows: Sequence[Sequence[object]]

    def report(self, name: str, title: str, flown: str, made_by: Mapping[str, str]) -> Report:
        """A report of this alone; `flown` and `made_by` are `Report`'s."""
        return Report(
            name=name, title=title, text=flown, data=self.data, rows=self.rows,
            tables=self.tables, figures=self.figures, flown=flown, made_by=made_by,
        )  # fmt: skip


def snapshots(records: Mapping[str, Mapping[str, FlightRecord]], folder: Path) -> Section:
    """Flights by world, and who flew, of whom the first is drawn. Raises OSError."""
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
               f"The cost at the end, and in brackets that of the true positions. {_COSTS}")],
        [Picture("snapshots.png", "snapshots"), Picture("costs.png", "costs")],
        curves_csv(named),
    )  # fmt: skip


def repeatability(trials: Mapping[str, FlightRecord], folder: Path, duration_s: float) -> Section:
    """Trials by name, looked at for so long. Raises OSError; ValueError if nobody was in all."""
    from_s = looked_at_from_s(trials, duration_s)
    seen = {name: looked_at(trials[name], from_s[name], duration_s) for name in trials}
    first = next(iter(trials.values()))
    # All of one world: it is drawn below their ends.
    records = [replace(each, name=name, coverage=first.coverage) for name, each in seen.items()]
    spread = spread_of(seen)
    style.save(flight_figures.repeatability(records), folder / "repeatability")
    rows = [
        [name, _final(record), f"{0.0 - from_s[name]:.0f} s", _final(trials[name])]
        for name, record in seen.items()
    ]
    headings = ["", f"cost after {spread['end_s']:.0f} s (in truth)", "mission began after",
                "cost at the mission's end / at its start"]  # fmt: skip
    begins = "Times count from the mission's start: points have no takeoff, and logs may not have "
    begins += f"one, or one more than {duration_s:g} s earlier."
    if any(from_s.values()):
        begins = (
            "Times count from the takeoff command. Robots take off one after another; until the "
            "mission begins, those on their pads count where they stand."
        )
    note = (
        f"{_COSTS} {begins}\nCosts after {spread['end_s']:.0f} s: mean "
        f"{spread['final_mean']:.3f}, standard deviation {spread['final_deviation']:.3f}; before "
        f"that the deviation is {spread['largest_deviation_in_flight']:.3f} at most. On average a "
        f"robot ends {spread['mean_scatter_of_ends_m']:.2f} m from the mean of its end positions. "
        f"{' '.join(who_is_missing(spread))}"
    )
    return Section(
        {
            "trials": curves_json(seen),
            "mission_from_s": {name: 0.0 - at_s for name, at_s in from_s.items()},
            "mission_final": {name: float(trials[name].normalized[-1]) for name in trials},
            "looked_at_s": duration_s,
            "spread": spread,
        },
        [Table(headings, rows, "Trial by trial", note)],
        [Picture("repeatability.png", "cost of all trials, and where robots end")],
        curves_csv(seen),
    )


def perturbation(flight: PerturbedFlight, folder: Path) -> Section:
    """A flight from which robots are taken. Raises OSError."""
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
        f"A robot is taken {len(flight.absences)} times. {_COSTS} The true one is the thin line, "
        "and is not in this table. Settled: from then on the cost stayed within 5 % of what it "
        "came to when the next thing happened, or the flight ended. `cost.csv` has the cost over "
        "time; speeds and neighbours are in the other CSV."
    )
    csv_rows: list[list[object]] = [["time_s", "robot", "speed_m_s", "neighbours"]]
    for time_s, speeds, neighbours in zip(
        flight.time_s.tolist(), flight.speed_m_s, flight.neighbours, strict=True
    ):
        its = zip(flight.record.robots, speeds.tolist(), neighbours.tolist(), strict=True)
        csv_rows += [[time_s, robot.name, speed, heard] for robot, speed, heard in its]
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
    """With the true one in brackets where vehicles tell."""
    curve = curves_json({"": record})[""]
    known = record.truth and curve["final_true"] is not None
    return f"{curve['final']:.3f}" + (f" ({curve['final_true']:.3f})" if known else "")


def true_curve(record: FlightRecord) -> F64:
    """(C,): the cost for where the robots truly were, over the first; NaN where it is not known."""
    return record.normalized if record.of_points else record.normalized_true


def curves_json(records: Mapping[str, FlightRecord]) -> dict[str, Any]:
    """Of each flight, by name: its cost and its true cost over those at the start.

    A true cost that is not known is None. The positions are of who was in the air in the end, by
    robot, as the record has them.
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
    """A heading, and a row for each flight and time; a true cost that is not known is empty."""
    rows: list[list[object]] = [["flight", "time_s", "cost_over_first", "true_cost_over_first"]]
    for name, curve in curves_json(records).items():
        curves = (curve["time_s"], curve["normalized_cost"], curve["normalized_true_cost"])
        rows += [[name, *row] for row in zip(*curves, strict=True)]
    return rows
