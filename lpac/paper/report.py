"""The experiments in the air as files: figures as PNG and PDF, CSV, JSON, and README.md."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lpac.analysis import figures, style
from lpac.analysis.flight import FlightRecord
from lpac.paper import experiments
from lpac.paper.experiments import PerturbedFlight, curves_csv, curves_json
from lpac.paper.figures import costs_by_world, perturbation

_LEAST_M, _MOST_M = experiments.GPS_ERROR_M
# How it was flown, for the reports.
POINTS = (
    "Points flew over worlds of the validation set, each at once with the velocity that its policy "
    "decided: without takeoff and landing, heights and wind, and with a GPS error, where there is "
    f"one ({_LEAST_M:g} to {_MOST_M:g} m), that stays as it is."
)
WHOLE = (
    "Whole robots flew over worlds of the validation set, from pads with room between them: their "
    "programs' loops and separation, on {vehicles}; what they are held against are points from "
    "the same pads."
)
TAKEN_POINTS = (
    f"{POINTS} A robot that is taken is gone: it says and hears nothing and does not count; it is "
    "back where it was, knowing nothing."
)
_PILOTED = (
    "a robot counts as taken while a pilot has it, and counts for the cost where it is meanwhile."
)
TAKEN_WHOLE = (
    "Whole robots flew over a world of the validation set: their programs' loops and separation, "
    "on {vehicles}. A simulated pilot takes the robot by its sticks, "
    f"flies it out of the fence at its height, and back to where it was; {_PILOTED}"
)
LOGS = "From the logs of flights."
TAKEN_LOGS = f"From the log of a flight: {_PILOTED}"


def write_transferability(
    records: Mapping[str, Mapping[str, FlightRecord]],
    folder: Path,
    made_by: Mapping[str, str],
    flown: str = POINTS,
) -> dict[str, Any]:
    """E1's: by world, and who flew, the policy first; gives its JSON. Raises OSError."""
    policies = {world: next(iter(of_world.values())) for world, of_world in records.items()}
    style.save(
        figures.snapshots_of_several(policies, experiments.SNAPSHOTS_S), folder / "snapshots"
    )
    style.save(costs_by_world(records), folder / "costs")
    told = {world: curves_json(of_world) for world, of_world in records.items()}
    named = {
        f"{world}, {name}": record
        for world, of_world in records.items()
        for name, record in of_world.items()
    }
    names = list(next(iter(records.values())))
    rows = [
        [world, *(_final(of_world[name]) for name in names)] for world, of_world in records.items()
    ]
    text = f"""# E1, transferability

The paper flies one policy over three worlds that it was not trained on, from the same starts, and
shows them at 0, 15, 30 and 60 s; it gives no costs. {flown}

![snapshots](snapshots.png)

![costs](costs.png)

Cost in the end over that at the start, in brackets where the vehicles truly were, if that is known:

{_table(["", *names], rows)}
"""
    return _write("e1", told, curves_csv(named), text, folder, made_by)


def _final(record: FlightRecord) -> str:
    told = curves_json({"": record})[""]
    true = "" if told["final_true"] is None else f" ({told['final_true']:.3f})"
    return f"{told['final']:.3f}{true}"


def write_repeatability(
    trials: Mapping[str, FlightRecord],
    folder: Path,
    made_by: Mapping[str, str],
    flown: str = POINTS,
) -> dict[str, Any]:
    """E2's; gives its JSON. Raises OSError."""
    first = next(iter(trials.values()))
    # All of one world: it is drawn below their ends.
    records = [
        replace(record, name=name, coverage=first.coverage) for name, record in trials.items()
    ]
    style.save(figures.repeatability(records), folder / "repeatability")
    spread = experiments.spread_of(list(trials.values()))
    rows = [[name, _final(record)] for name, record in trials.items()]
    text = f"""# E2, repeatability

The paper flies one world three times, each robot placed within 10 cm of the same start, and shows
the cost over 40 s from the takeoff command: the curves differ, the costs at the end are similar,
and GPS (1 to 5 m) scatters where robots end. Here {len(trials)} trials, and times count from the
mission's start: before it nobody covers. {flown}

![repeatability](repeatability.png)

{_table(["", "cost in the end / at the start (in truth)"], rows)}

Costs at the end: mean {spread["final_mean"]:.3f}, standard deviation
{spread["final_deviation"]:.3f}; in flight the deviation is
{spread["largest_deviation_in_flight"]:.3f} at most. A robot ends
{spread["mean_scatter_of_ends_m"]:.2f} m from the mean of its ends, on average.
"""
    told = {"trials": curves_json(trials), "spread": spread}
    return _write("e2", told, curves_csv(trials), text, folder, made_by)


def write_perturbation(
    perturbed: PerturbedFlight,
    folder: Path,
    made_by: Mapping[str, str],
    flown: str = POINTS,
) -> dict[str, Any]:
    """E3's; gives its JSON. Raises OSError."""
    style.save(perturbation(perturbed), folder / "perturbation")
    rows = [
        [
            f"robot {phase.robot} {'away' if phase.away else 'back'}",
            f"{phase.from_s:g} to {phase.until_s:g} s",
            f"{phase.cost_before:.3f}", f"{phase.cost_worst:.3f}", f"{phase.cost_end:.3f}",
            f"{phase.settled_s:.0f} s",
        ]
        for phase in perturbed.phases
    ]  # fmt: skip
    headings = ["", "when", "cost before", "worst", "at the end", "settled after"]
    text = f"""# E3, perturbation

In each of the paper's experiments a pilot takes one robot at steady state, flies it out of the area
and brings it back to about the same place; it has no figure of its own. Here a robot of one flight
is taken {len(perturbed.absences)} times. {flown}

![perturbation](perturbation.png)

{_table(headings, rows)}

Costs are over that at the start. Settled: from then on the cost stayed within 5 % of what it came
to when the next thing happened, or the flight ended.
"""
    told = {
        "flight": curves_json({"": perturbed.record})[""],
        "phases": [phase._asdict() for phase in perturbed.phases],
    }
    rows_csv: list[list[object]] = [["time_s", "robot", "speed_m_s", "neighbours"]]
    for time_s, speeds, neighbours in zip(
        perturbed.time_s.tolist(), perturbed.speed_m_s, perturbed.neighbours, strict=True
    ):
        its = zip(perturbed.record.robots, speeds.tolist(), neighbours.tolist(), strict=True)
        rows_csv += [[time_s, robot.name, speed, heard] for robot, speed, heard in its]
    return _write("e3", told, rows_csv, text, folder, made_by)


def _write(
    name: str,
    told: Mapping[str, Any],
    rows: Sequence[Sequence[object]],
    text: str,
    folder: Path,
    made_by: Mapping[str, str],
) -> dict[str, Any]:
    document = {**told, "made_by": dict(made_by)}
    (folder / f"{name}.json").write_text(json.dumps(document, indent=2) + "\n")
    written = io.StringIO()
    csv.writer(written, lineterminator="\n").writerows(rows)
    (folder / f"{name}.csv").write_text(written.getvalue())
    made = "; ".join(f"{what}: `{value}`" for what, value in made_by.items())
    (folder / "README.md").write_text(
        f"{text}\n`{name}.csv` and `{name}.json` have it all. {made}.\n"
    )
    return document


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
