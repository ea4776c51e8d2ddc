"""A study's results for people: tables of its report and of the terminal, and figures."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import edge
import lpac
from edge.core.counted import counted
from edge.policy.bundle import load_bundle
from lpac.analysis import style
from lpac.analysis.figures import snapshots_and_costs
from lpac.analysis.flight import FlightRecord
from lpac.analysis.statistics import VERDICT_RULE, Interval95, what_would_tell
from lpac.radio.airtime import LinkQuality
from lpac.sim.cores import Pool
from lpac.sim.engines import EngineName
from lpac.sim.kept import KeptOutcomes, code_digest
from lpac.study import figures, rates
from lpac.study.flights import CLAIRVOYANT, PlannedFlight, fly_all, records_of
from lpac.study.perturbation import absences_in, absences_of, perturbed_by
from lpac.study.receiving_robot import message_bytes
from lpac.study.report import Picture, Report, Table
from lpac.study.results import MethodResult, as_json, worst_worlds
from lpac.study.run import Flown, OnProgress
from lpac.study.sections import Section, perturbation, repeatability, snapshots
from lpac.study.study import USUAL_FIGURES, Condition, Draw, Figure, Study

# Name of whole robots in figures with points.
WHOLE_ROBOTS = "whole robots"
# Number of worlds shown per policy, under the first condition.
_WORST = 10
# Lists the pictures with the keys of their flights.
_DRAWN = "drawn.jsonl"
_FLOWN: dict[EngineName, str] = {
    "point": "Points fly what the policies decide: without takeoff, landing, heights and wind.",
    "simulated": "Whole robots fly, with their programs' loops and separation, on simulated PX4s "
    "and one simulated clock.",
    "mavlink": "Whole robots fly, a program for each robot in real time, on simulated PX4s.",
    "px4": "Whole robots fly, a program for each robot in real time, on real PX4s that run as "
    "software.",
}
_WHOLE = (
    "Costs of whole robots are at their vehicles' true positions. Their curves may begin above 1: "
    "whole robots drift from their pads until the mission begins, and costs are relative to the "
    "least initial cost of any method. Baselines fly as points, from the same pads and with the "
    "same receiver errors."
)
_COLUMNS = (
    "", "mean\nJ / J(0)", "95 %", "p90", "worst", "area", "vs\nclair-\nvoyant", "p90",
    "vs\nbest\nLloyd",
)  # fmt: skip
# Explains the columns and the rule of comparison, once below all tables.
LEGEND = (
    "J / J(0): final cost over initial cost: its mean over the worlds, with the 95 % interval; "
    "p90: nine worlds in ten end below; worst: the worst world\n"
    "area: mean of J / J(0) over the flight\n"
    "vs clairvoyant: ratio to Lloyd's algorithm with knowledge of the world, of means and, world "
    "by world, p90\n"
    "vs best Lloyd: ratio to the best of ten such runs, in each world\n"
    "over the mission: mean cost at that time, and in brackets over the clairvoyant's then; rise: "
    "how far a cost rises above its best before, from 60 s on: mean over the worlds, and worst\n"
    f"{VERDICT_RULE}; otherwise they are not distinguishable"
)


def flown_as(study: Study) -> str:
    """Description of the engines."""
    engines = dict.fromkeys(condition.engine for condition in study.conditions)
    text = [_FLOWN[engine] for engine in engines]
    return " ".join([*text, _WHOLE] if set(engines) != {"point"} else text)


def tables_of(data: Mapping[str, Any]) -> list[Table]:
    """Tables of each condition: costs, and comparisons of policies with baselines.

    `data` is a study's JSON, see `lpac.study.results.as_json`.
    """
    return [table for condition in data["conditions"] for table in _tables(data, condition)]


def _tables(data: Mapping[str, Any], condition: Mapping[str, Any]) -> Iterator[Table]:
    results = condition["results"]
    named = {method["name"]: method for method in data["methods"]}
    policies = [result for result in results if named[result["name"]]["bundles"]]
    over = f"{counted(data['worlds'], 'world')} of the {data['world_set']} set"
    if data["world_set"] is None:
        over = "all missions of such a team"
    elif data["trials_per_world"] > 1:
        over = f"{over}, {data['trials_per_world']} trials in each"
    note = [] if data["world_set"] is None else [_flown(condition)]
    if condition["scenario"]["radio"] is not None:
        note.append(LinkQuality(**condition["scenario"]["link"]).in_words)
    note += [
        f"{each['name']}: {_share(each['fails'])} of the worlds end above "
        f"{data['fails_above']:g} x clairvoyant; in {_share(each['rises_again'])} costs rise again"
        for each in policies
    ]
    if condition["compared"] is not None:
        [a, b, *_] = results
        note += _verdict(condition["compared"], a["name"], b["name"], data["worlds"])
    yield Table(
        _COLUMNS,
        [_row(result) for result in results],
        f"{condition['name']}: {over}, {condition['scenario']['duration_s']:g} s",
        "\n".join(note),
    )
    if len(results[0]["over_mission"]) > 1:
        times = [f"{at['time_s']:g} s" for at in results[0]["over_mission"]]
        yield Table(("over the mission", *times, "rise"), [_mission_row(each) for each in results])
    if policies and len(policies) < len(results):
        rows = [
            [baseline["name"], *(_against(policy, baseline["name"]) for policy in policies)]
            for baseline in results
            if baseline not in policies
        ]
        headings = ("against", *(policy["name"] for policy in policies))
        yield Table(headings, rows)


def _flown(condition: Mapping[str, Any]) -> str:
    """Text of the sizes and the engine."""
    duration_s, engine = condition["scenario"]["duration_s"], condition["engine"]
    return f"{condition['sizes']}, {duration_s:g} s, engine {engine}"


def _row(result: Mapping[str, Any]) -> list[str]:
    final, over = result["final"], result["over_clairvoyant"]
    mean, low, high = final["mean"]
    return [
        result["name"],
        f"{mean:.3f}",
        f"{low:.3f}-{high:.3f}",
        f"{final['quantiles']['0.9']:.3f}",
        f"{final['worst']:.3f}",
        f"{result['area']['mean'][0]:.3f}",
        f"{over['ratio_of_means'][0]:.3f}",
        f"{over['quantiles']['0.9']:.2f}",
        f"{result['over_best_of_ten']['ratio_of_means'][0]:.3f}",
    ]


def _mission_row(result: Mapping[str, Any]) -> list[str]:
    rise = result["worst_rise"]
    return [
        result["name"],
        *(f"{at['mean']:.3f} ({at['over_clairvoyant']:.2f})" for at in result["over_mission"]),
        f"{100.0 * rise['mean'][0]:.0f} %, worst {100.0 * rise['worst']:.0f} %",
    ]


def _share(data: Mapping[str, Any]) -> str:
    """Text of a share and its bound."""
    share, bound = 100.0 * data["share"], 100.0 * data["at_most_share"]
    return f"{share:.3g} % (95 %: at most {bound:.3g})"


def _against(policy: Mapping[str, Any], baseline: str) -> str:
    """Text of the comparison with a baseline, and the share of worlds above it."""
    above, verdict = policy["above"][baseline], policy["against"][baseline]
    text = {"a": "better", "b": "worse", None: "not distinguishable"}[verdict["better"]]
    return f"{text}, above it in {100.0 * above['share']:.3g} %"


def _verdict(verdict: Mapping[str, Any], a: str, b: str, worlds: int) -> Iterator[str]:
    """Text of the comparison of two policies."""
    ratio, below = verdict["ratio"], verdict["a_below_b"]
    text = f"the data do not show whether {a} or {b} is better"
    if verdict["better"] is not None:
        better, worse = (a, b) if verdict["better"] == "a" else (b, a)
        text = f"{better} is better than {worse}"
    yield (
        f"{text}: cost at the end {ratio[0]:.3f} times (95 %: {ratio[1]:.3f} to {ratio[2]:.3f}), "
        f"lower in {100.0 * below[0]:.3g} % of the worlds ({100.0 * below[1]:.3g} to "
        f"{100.0 * below[2]:.3g})"
    )
    if verdict["better"] is None:
        yield what_would_tell(Interval95(*verdict["difference"]), worlds)
    if not verdict["of_methods"]:
        yield (
            "this holds for these bundles; a claim about the methods needs three trainings of each"
        )


def report_of(
    name: str,
    study: Study,
    flown: Flown,
    folder: Path,
    made_by: Mapping[str, str],
    further: Mapping[str, Any],
    *,
    compared: bool = False,
) -> Report:
    """Make a study's report and draw its figures; `further` is added to the JSON.

    Raises OSError; ValueError if the flights do not allow a figure.
    """
    sections = _sections_of(study, flown, folder)
    data = as_json(study, flown.results, compared=compared)
    for section in sections:
        data |= section.data
    # The section of the rates contains all conditions.
    of_conditions, text = tables_of(data), study.text
    if "rates" in study.figures:
        of_conditions, text = [], f"{text} First condition: {_flown(data['conditions'][0])}."
    return Report(
        name=name,
        title=study.title or name,
        text=f"{text} {flown_as(study)}".strip(),
        legend=LEGEND if of_conditions else "",
        data={**data, **further},
        rows=next((section.rows for section in sections), rows_of(data)),
        tables=[*(table for section in sections for table in section.tables), *of_conditions],
        figures=[picture for section in sections for picture in section.figures]
        + draw_conditions(flown.results, folder, study.figures),
        flown=flown_as(study),
        beside=_worst_pictures(study) if "worst" in study.figures else "",
        made_by=made_by,
    )


def _worst_pictures(study: Study) -> str:
    """Text about the pictures; "" if no policy flies under the first condition."""
    condition = study.conditions[0]
    policies = [method.name for method in study.methods_of(condition) if method.trained]
    if not policies:
        return ""
    return (
        f"[`worst`](worst) has pictures of the worst worlds, at most {_WORST}, of "
        f"{' and '.join(policies)} under the first condition, {condition.name}: highest over "
        "clairvoyant first."
    )


def _sections_of(study: Study, flown: Flown, folder: Path) -> list[Section]:
    """Sections of whole flights and of rates. Raises OSError, ValueError."""
    condition = study.conditions[0]
    policy = study.methods_of(condition)[0]
    first = {
        draw: flown.records.get(next(study.flights_of(policy, condition, draw)))
        for draw in study.draws
    }
    records = {_name(study, draw): record for draw, record in first.items() if record is not None}
    sections = []
    if "snapshots" in study.figures:
        sections.append(snapshots(_by_world(study, flown.records), folder))
    if "repeatability" in study.figures:
        sections.append(repeatability(records, folder, condition.scenario.duration_s))
    if "perturbation" in study.figures:
        [record, *_] = records.values()
        assert condition.scenario.communication_range is not None
        range_m = condition.scenario.communication_range / condition.scenario.scale.env_scale
        absences = (
            absences_in(condition.scenario) if condition.engine == "point" else absences_of(record)
        )
        sections.append(perturbation(perturbed_by(record, absences, range_m), folder))
    if "rates" in study.figures:
        message_size = message_bytes(load_bundle(study.sized_by), 2)
        results = rates.results_of(flown.results, [_name(study, draw) for draw in study.draws])
        sections.append(rates.rates(results, message_size, folder))
    return sections


def _name(study: Study, draw: Draw) -> str:
    """Name of a draw among a policy's flights under one condition."""
    world, trial = f"world {draw.world}", f"trial {draw.trial + 1}"
    if study.trials == 1:
        return world
    return trial if study.worlds == 1 else f"{world}, {trial}"


def _by_world(
    study: Study, records: Mapping[PlannedFlight, FlightRecord]
) -> dict[str, dict[str, FlightRecord]]:
    """Flights by world and method; the first one of several trainings."""
    found: dict[str, dict[str, FlightRecord]] = {}
    for draw in study.draws:
        for condition in study.conditions:
            for policy in study.methods_of(condition):
                is_whole = policy.trained and condition.engine != "point"
                name = WHOLE_ROBOTS if is_whole else policy.name
                flight = next(study.flights_of(policy, condition, draw))
                found.setdefault(_name(study, draw), {}).setdefault(name, records[flight])
    return found


def rows_of(data: Mapping[str, Any]) -> list[list[object]]:
    """CSV rows: a heading, then one per condition, policy, training and world."""
    rows: list[list[object]] = [
        ["condition", "method", "training", "world", "cost_over_first", "over_clairvoyant"]
    ]
    for condition in data["conditions"]:
        for result in condition["results"]:
            costs, over = (result["by_world"][key] for key in ("final", "over_clairvoyant"))
            rows += [
                [condition["name"], result["name"], training, data["first_world"] + world, *both]
                for training, of_training in enumerate(zip(costs, over, strict=True))
                for world, both in enumerate(zip(*of_training, strict=True))
            ]
    return rows


def draw_conditions(
    results: Mapping[Condition, Sequence[MethodResult]],
    folder: Path,
    chosen: Sequence[Figure] = USUAL_FIGURES,
) -> list[Picture]:
    """Draw the chosen figures of all conditions. Raises OSError."""
    shown = []
    if "conditions" in chosen and len(results) > 1:
        style.save(figures.over_conditions(results), folder / "conditions")
        shown.append(Picture("conditions.png", "mean cost over clairvoyant Lloyd's"))
    for condition, of_all in results.items():
        for figure, make in _OF_CONDITION.items():
            if figure in chosen:
                path = f"{condition.folder}/{figure}"
                style.save(make(condition, of_all), folder / path)
                shown.append(Picture(f"{path}.png", f"{condition.name}: {figure}"))
    return shown


_OF_CONDITION = {
    "curves": figures.cost_curves,
    "distributions": figures.distributions,
    "pairs": figures.pairs,
}


def draw_worst(
    study: Study,
    results: Mapping[Condition, Sequence[MethodResult]],
    folder: Path,
    pool: Pool,
    on_progress: OnProgress = lambda *_: None,
) -> None:
    """Fly the worst worlds of each policy under the first condition again, and draw them.

    Existing pictures of the same flights stay. Raises OSError.
    """
    condition, of_all = next(iter(results.items()))
    clairvoyant = next(r.method for r in of_all if r.method.name == CLAIRVOYANT)
    wanted = {
        (result.method.name, place, study.draws[index].world): [
            next(study.flights_of(policy, condition, study.draws[index]))
            for policy in (result.method, clairvoyant)
        ]
        for result in of_all
        if result.method.trained
        for place, index in enumerate(worst_worlds(result, _WORST), 1)
    }
    drawn = KeptOutcomes(folder / "worst" / _DRAWN, {"code": code_digest(edge, lpac)})
    missing = []
    for (name, place, world), pair in wanted.items():
        path = folder / "worst" / name.replace("/", "-") / f"{place:02d}-world-{world}"
        line = {"picture": str(path.relative_to(folder)), "of": [flight.key for flight in pair]}
        newest = [each for each in drawn.lines if each["picture"] == line["picture"]][-1:]
        if newest != [line] or not path.with_suffix(".png").exists():
            missing.append((name, path, line, pair))
    flights = list(dict.fromkeys(flight for *_, pair in missing for flight in pair))
    flown: dict[PlannedFlight, FlightRecord] = {}
    planned = len(flights) + len(missing)
    for flight, record in fly_all(records_of, flights, pool):
        flown[flight] = record
        on_progress(len(flown), planned)
    for done, (name, path, line, (own, best)) in enumerate(missing, 1):
        style.save(snapshots_and_costs({name: flown[own], CLAIRVOYANT: flown[best]}), path)
        drawn.add(line)
        on_progress(len(flown) + done, planned)
