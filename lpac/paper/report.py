"""The experiments as files: figures as PNG and PDF, CSV, JSON, and README.md."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lpac.analysis import figures, style
from lpac.analysis.flight import FlightRecord
from lpac.paper import experiments
from lpac.paper.experiments import PerturbedFlight, curves_csv, curves_json
from lpac.paper.figures import costs_by_world, perturbation
from lpac.paper.files import table, write_csv, write_experiment
from lpac.sim.fleet.layout import MAX_ROBOTS

_LEAST_M, _MOST_M = experiments.GPS_ERROR_M
# How it was flown, for the reports.
_POINTS = (
    "Points flew over worlds of the validation set, each taking on its policy's velocity "
    "instantly: without takeoff, landing, heights and wind"
)
POINTS = (
    f"{_POINTS}, and with a GPS error, where there is one ({_LEAST_M:g} to {_MOST_M:g} m), that "
    "stays as it is."
)
EXACT_POINTS = f"{_POINTS}, and without GPS errors."
WHOLE = (
    "Whole robots flew over worlds of the validation set, from pads with room between them: their "
    "programs' loops and separation, on {vehicles}."
)
WHOLE_BESIDE_POINTS = f"{WHOLE} They are compared with points that start from the same pads."
WHOLE_IN_TRUTH = (
    f"{WHOLE} Costs are those of the vehicles' true positions. Where messages are late, they are "
    "late from the mission's start on."
)
WHOLE_TRANSFERRED = (
    f"{WHOLE} They did so in set-ups of up to {MAX_ROBOTS} robots, beside points from the same "
    "pads with the same receivers' errors, and points from anywhere without errors. Costs are "
    "those of true positions. Lloyd's algorithm has the same starts as whole robots."
)
TAKEN_POINTS = (
    f"{POINTS} A robot that is taken is gone: it says and hears nothing and does not count; it is "
    "back where it was, knowing nothing."
)
_PILOTED = (
    "a robot counts as taken while a pilot has it; for the cost it still counts, at its place."
)
TAKEN_WHOLE = (
    "Whole robots flew over a world of the validation set: their programs' loops and separation, "
    "on {vehicles}. A simulated pilot takes the robot by its sticks, "
    f"flies it out of the fence at its height, and back to where it was; {_PILOTED}"
)
LOGS = "From the logs of flights."
LOGS_BY_RATES = (
    f"{LOGS} The missions of each rate are compared with those at the field's; costs are those of "
    "the robots' estimated positions."
)
LOGS_BESIDE_POINTS = (
    f"{LOGS} They are compared with points from where the robots were when the mission began."
)
TAKEN_LOGS = f"From the log of a flight: {_PILOTED}"
NETWORK = "No vehicles: programs that send what robots send, beside a stream, measured {where}."
_COSTS = (
    "Costs are divided by that at the start: for points, of their true positions; for whole robots "
    "and logs, of estimated positions, and of true ones where those are known."
)


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
    told = {"worlds": {world: curves_json(of_world) for world, of_world in records.items()}}
    named = {
        f"{world}, {name}": record
        for world, of_world in records.items()
        for name, record in of_world.items()
    }
    names = list(dict.fromkeys(name for of_world in records.values() for name in of_world))
    rows = [
        [world, *(_final(of_world[name]) if name in of_world else "" for name in names)]
        for world, of_world in records.items()
    ]
    text = f"""# E1, transferability

The paper flies one policy over three worlds that it was not trained on, from the same starts, and
shows them at 0, 15, 30 and 60 s; it gives no costs. {flown}

![snapshots](snapshots.png)

![costs](costs.png)

The cost at the end, and in brackets that of the true positions. {_COSTS}

{table(["", *names], rows)}
"""
    return write_experiment("e1", told, curves_csv(named), text, folder, flown, made_by)


def _final(record: FlightRecord) -> str:
    """With the true one in brackets where vehicles tell."""
    told = curves_json({"": record})[""]
    known = record.truth and told["final_true"] is not None
    return f"{told['final']:.3f}" + (f" ({told['final_true']:.3f})" if known else "")


def write_repeatability(
    trials: Mapping[str, FlightRecord],
    folder: Path,
    made_by: Mapping[str, str],
    flown: str = POINTS,
) -> dict[str, Any]:
    """E2's; gives its JSON. Raises OSError; ValueError if no robot was in all trials."""
    from_s = experiments.looked_at_from_s(trials)
    looked_at = {name: experiments.looked_at(trials[name], from_s[name]) for name in trials}
    first = next(iter(trials.values()))
    # All of one world: it is drawn below their ends.
    records = [
        replace(record, name=name, coverage=first.coverage) for name, record in looked_at.items()
    ]
    spread = experiments.spread_of(looked_at)
    style.save(figures.repeatability(records), folder / "repeatability")
    rows = [
        [name, _final(record), f"{0.0 - from_s[name]:.0f} s", _final(trials[name])]
        for name, record in looked_at.items()
    ]
    headings = ["", f"cost after {spread['end_s']:.0f} s (in truth)", "mission began after",
                "cost at the mission's end / at its start"]  # fmt: skip
    text = f"""# E2, repeatability

The paper flies one world three times, each robot placed within 10 cm of the same start, and shows
the cost over {experiments.E2_DURATION_S:g} s from the takeoff command: the curves differ, the costs
at the end are similar, and GPS (1 to 5 m) scatters where robots end. Here: {len(trials)} trials.
{_looked_at_text(from_s)} {flown}

![repeatability](repeatability.png)

{table(headings, rows)}

{_COSTS}

Costs after {spread["end_s"]:.0f} s: mean {spread["final_mean"]:.3f}, standard deviation
{spread["final_deviation"]:.3f}; before that the deviation is
{spread["largest_deviation_in_flight"]:.3f} at most. On average a robot ends
{spread["mean_scatter_of_ends_m"]:.2f} m from the mean of its end positions.
{" ".join(experiments.who_is_missing(spread))}
"""
    told = {
        "trials": curves_json(looked_at),
        "mission_from_s": {name: 0.0 - at_s for name, at_s in from_s.items()},
        "mission_final": {name: float(trials[name].normalized[-1]) for name in trials},
        "spread": spread,
    }
    return write_experiment("e2", told, curves_csv(looked_at), text, folder, flown, made_by)


def _looked_at_text(from_s: Mapping[str, float]) -> str:
    if any(from_s.values()):
        return (
            "Times count from the takeoff command here, too. Our robots take off one after "
            "another; until the mission begins, those on their pads count where they stand."
        )
    return (
        "Times count from the mission's start: points have no takeoff, and logs may not have one, "
        f"or one more than {experiments.E2_DURATION_S:g} s earlier."
    )


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
            f"{phase.from_s:.0f} to {phase.until_s:.0f} s",
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

{table(headings, rows)}

{_COSTS} The true one is the thin line, and is not in this table. Settled: from then on the cost
stayed within 5 % of what it came to when the next thing happened, or the flight ended.
`e3-cost.csv` has the cost over time, `e3.csv` speeds and neighbours.
"""
    told = {
        "flight": curves_json({"": perturbed.record})[""],
        "phases": [phase._asdict() for phase in perturbed.phases],
        "neighbours": {
            "mean": float(np.nanmean(perturbed.neighbours)),
            "others": len(perturbed.record.robots) - 1,
        },
    }
    rows_csv: list[list[object]] = [["time_s", "robot", "speed_m_s", "neighbours"]]
    for time_s, speeds, neighbours in zip(
        perturbed.time_s.tolist(), perturbed.speed_m_s, perturbed.neighbours, strict=True
    ):
        its = zip(perturbed.record.robots, speeds.tolist(), neighbours.tolist(), strict=True)
        rows_csv += [[time_s, robot.name, speed, heard] for robot, speed, heard in its]
    write_csv(curves_csv({"flight": perturbed.record}), folder / "e3-cost.csv")
    return write_experiment("e3", told, rows_csv, text, folder, flown, made_by)


def write_transfer(
    told: Mapping[str, Any],
    folder: Path,
    made_by: Mapping[str, str],
    flown: str = EXACT_POINTS,
) -> dict[str, Any]:
    """Beside what `lpac evaluate` wrote, whose JSON is `told`; gives all JSON. Raises OSError."""
    policies = [method["name"] for method in told["methods"] if method["bundles"]]
    rows, rows_csv = [], [_TRANSFER_COLUMNS]
    for condition in told["conditions"]:
        of_all = {result["name"]: result for result in condition["results"]}
        rows.append([condition["name"], *(_transferred(of_all[name]) for name in policies)])
        rows_csv += [
            [condition["name"], name, training, world, cost, over]
            for name, result in of_all.items()
            for training, of_training in enumerate(
                zip(result["by_world"]["final"], result["by_world"]["over_clairvoyant"],
                    strict=True)
            )
            for world, (cost, over) in enumerate(zip(*of_training, strict=True))
        ]  # fmt: skip
    # One alone is no comparison.
    several = len(told["conditions"]) > 1
    picture = "\n![mean cost over clairvoyant Lloyd's](conditions.png)\n" if several else ""
    first = "one world" if told["worlds"] == 1 else f"the first {told['worlds']} worlds"
    worlds = f"in {first} of the {told['world_set']} set"
    if told["world_set"] is None:
        worlds = "of each team's missions"
    text = f"""# Transfer to other teams and worlds

The paper flies a policy that was trained with 32 robots in 1024 x 1024 cells with 10 robots in
512 x 512; its other paper has more and fewer robots, features and ranges.
{flown}
{picture}
{table(["", *policies], rows)}

Mean cost after {told["duration_s"]:.0f} s over that at the start, {worlds}, and in brackets its
ratio to that of Lloyd's algorithm with knowledge of the world, with the 95 % interval where there
are enough flights for one. A folder for each set-up has its curves.
"""
    return write_experiment("transfer", told, rows_csv, text, folder, flown, made_by)


_TRANSFER_COLUMNS: list[object] = [
    "set_up", "method", "training", "world", "cost_over_first", "over_clairvoyant",
]  # fmt: skip


def _transferred(result: Mapping[str, Any]) -> str:
    ratio, low, high = result["over_clairvoyant"]["ratio_of_means"]
    # One world says nothing of others.
    several = len(result["by_world"]["final"][0]) > 1
    interval = f", {low:.2f} to {high:.2f}" if several else ""
    return f"{result['final']['mean'][0]:.3f} (x {ratio:.2f}{interval})"


def write_network(
    told: Mapping[str, Any], folder: Path, made_by: Mapping[str, str]
) -> dict[str, Any]:
    """Beside the figures of `lpac bench network`, whose JSON is `told`; gives all JSON.

    Raises OSError.
    """
    measured_on = told["measured_on"]
    on_loopback = measured_on["where"] == "loopback"
    where = "on this machine's loopback, which has no radio" if on_loopback else (
        f"between network namespaces ({', '.join(measured_on['namespaces'])})"
    )  # fmt: skip
    flown = NETWORK.format(where=where)
    rows = [
        [of["experiment"], of["middleware"], str(of["robots"]),
         _spread(of.get("throughput_mbit_s")), _spread(of.get("delivered"), 100.0),
         _spread(of.get("age_p50_ms"))]
        for of in told["summaries"]
    ]  # fmt: skip
    headings = ["", "", "robots", "Mbit/s", "delivered, %", "age p50, ms"]
    figures_made = "\n\n".join(
        f"![{name}]({name}.png)" for name in dict.fromkeys(of["experiment"] for of in told["runs"])
    )
    versions = ", ".join(f"{name} {version}" for name, version in measured_on["versions"].items())
    unmet = sum(not run["met"] for run in told["runs"])
    not_met = f"Runs left out, before which not all robots had met: {unmet}. " if unmet else ""
    text = f"""# Network

The paper measures what a stream gets while the programs of three robots restart (Table I), and how
that falls as robots are switched on one after another. {flown}

{figures_made}

{table(headings, rows)}

Mean and standard deviation over the runs. {not_met}{versions}; Linux {measured_on["kernel"]},
{measured_on["cores"]} cores.
"""
    runs = told["runs"]
    rows_csv = [list(runs[0]), *(list(run.values()) for run in runs)]
    return write_experiment("network", told, rows_csv, text, folder, flown, made_by)


def _spread(of: Mapping[str, Any] | None, factor: float = 1.0) -> str:
    if of is None:
        return ""
    mean = f"{factor * of['mean']:.1f}"
    return mean if of["deviation"] is None else f"{mean} ± {factor * of['deviation']:.1f}"
