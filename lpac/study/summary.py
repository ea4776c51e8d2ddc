"""A study's results for people: the tables of its report and of the terminal, and its figures."""

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
from lpac.study.hearing_robot import message_bytes
from lpac.study.perturbation import absences_in, absences_of, perturbed_by
from lpac.study.report import Picture, Report, Table
from lpac.study.results import MethodResult, as_json, worst_worlds
from lpac.study.run import Flown, Tell
from lpac.study.sections import Section, perturbation, repeatability, snapshots
from lpac.study.study import USUAL_FIGURES, Condition, Draw, Figure, Study

# What these are called beside points.
WHOLE_ROBOTS = "whole robots"
# Of each policy, under the first condition.
_WORST = 10
# Which pictures there are, and of which flights.
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
    "Costs of whole robots are those of their vehicles' true positions. Curves may begin above 1: "
    "until the mission begins, whole robots drift from their pads, and costs are over the least "
    "that any method begins with. Baselines fly as points, from the same pads and with the same "
    "receivers' errors."
)
_COLUMNS = (
    "", "mean\nJ / J(0)", "95 %", "p90", "worst", "area", "vs\nclair-\nvoyant", "p90",
    "vs\nbest\nLloyd",
)  # fmt: skip
# What the columns are, and by which rule one is called better; said once below all tables.
LEGEND = (
    "J / J(0): cost at the end over that at the start: its mean over the worlds and in which "
    "interval that is, at 95 % confidence; p90: nine worlds of ten end below, worst: the worst\n"
    "area: the mean of J / J(0) over the flight, so the area under its curve\n"
    "vs clairvoyant: how many times that of Lloyd's algorithm that knows the world, mean over "
    "mean, and, world by world, p90\n"
    "vs best Lloyd: how many times that of the best of ten such runs, in each world\n"
    f"{VERDICT_RULE}; else they are not told apart"
)


def flown_as(study: Study) -> str:
    """How it was flown, in sentences."""
    engines = dict.fromkeys(condition.engine for condition in study.conditions)
    said = [_FLOWN[engine] for engine in engines]
    return " ".join([*said, _WHOLE] if set(engines) != {"point"} else said)


def tables_of(told: Mapping[str, Any]) -> list[Table]:
    """Of each condition: how policies cover, and whether they are better than the baselines.

    `told` is a study's JSON, see `lpac.study.results.as_json`.
    """
    return [table for condition in told["conditions"] for table in _tables(told, condition)]


def _tables(told: Mapping[str, Any], condition: Mapping[str, Any]) -> Iterator[Table]:
    results = condition["results"]
    named = {method["name"]: method for method in told["methods"]}
    policies = [result for result in results if named[result["name"]]["bundles"]]
    over = f"{counted(told['worlds'], 'world')} of the {told['world_set']} set"
    if told["world_set"] is None:
        over = "all missions of such a team"
    elif told["trials_per_world"] > 1:
        over = f"{over}, {told['trials_per_world']} trials in each"
    note = [] if told["world_set"] is None else [_flown(condition)]
    if condition["scenario"]["radio"] is not None:
        note.append(LinkQuality(**condition["scenario"]["link"]).in_words)
    note += [
        f"{each['name']}: {_share(each['fails'])} of the worlds end above "
        f"{told['fails_above']:g} x clairvoyant; in {_share(each['rises_again'])} costs rise again"
        for each in policies
    ]
    if condition["compared"] is not None:
        [a, b, *_] = results
        note += _verdict(condition["compared"], a["name"], b["name"], told["worlds"])
    yield Table(
        _COLUMNS,
        [_row(result) for result in results],
        f"{condition['name']}: {over}, {condition['scenario']['duration_s']:g} s",
        "\n".join(note),
    )
    if policies and len(policies) < len(results):
        rows = [
            [baseline["name"], *(_against(policy, baseline["name"]) for policy in policies)]
            for baseline in results
            if baseline not in policies
        ]
        headings = ("against", *(policy["name"] for policy in policies))
        yield Table(headings, rows)


def _flown(condition: Mapping[str, Any]) -> str:
    """The sizes and the engine."""
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


def _share(told: Mapping[str, Any]) -> str:
    """With how much it may be in truth."""
    share, bound = 100.0 * told["share"], 100.0 * told["at_most_share"]
    return f"{share:.3g} % (95 %: at most {bound:.3g})"


def _against(policy: Mapping[str, Any], baseline: str) -> str:
    """Whether better, and in how many worlds it ends above the baseline."""
    above, verdict = policy["above"][baseline], policy["against"][baseline]
    text = {"a": "better", "b": "worse", None: "not told apart"}[verdict["better"]]
    return f"{text}, above it in {100.0 * above['share']:.3g} %"


def _verdict(verdict: Mapping[str, Any], a: str, b: str, worlds: int) -> Iterator[str]:
    """Whether the first of two policies is better, and how surely."""
    ratio, below = verdict["ratio"], verdict["a_below_b"]
    said = f"the data do not show whether {a} or {b} is better"
    if verdict["better"] is not None:
        better, worse = (a, b) if verdict["better"] == "a" else (b, a)
        said = f"{better} is better than {worse}"
    yield (
        f"{said}: cost at the end {ratio[0]:.3f} times (95 %: {ratio[1]:.3f} to {ratio[2]:.3f}), "
        f"lower in {100.0 * below[0]:.3g} % of the worlds ({100.0 * below[1]:.3g} to "
        f"{100.0 * below[2]:.3g})"
    )
    if verdict["better"] is None:
        yield what_would_tell(Interval95(*verdict["difference"]), worlds)
    if not verdict["of_methods"]:
        yield (
            "that is true of these bundles; it takes three trainings of each to say it of the "
            "methods"
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
    """The report of a study, whose JSON has what is `further` to be told; draws its figures.

    Raises OSError; ValueError if flights do not show what a figure is of.
    """
    sections = _sections_of(study, flown, folder)
    told = as_json(study, flown.results, compared=compared)
    for section in sections:
        told |= section.told
    # That of the rates has all conditions in it.
    of_conditions, text = tables_of(told), study.text
    if "rates" in study.figures:
        of_conditions, text = [], f"{text} First condition: {_flown(told['conditions'][0])}."
    return Report(
        name=name,
        title=study.title or name,
        text=f"{text} {flown_as(study)}".strip(),
        legend=LEGEND if of_conditions else "",
        told={**told, **further},
        rows=next((section.rows for section in sections), rows_of(told)),
        tables=[*(table for its in sections for table in its.tables), *of_conditions],
        figures=[picture for its in sections for picture in its.figures]
        + draw_conditions(flown.results, folder, study.figures),
        flown=flown_as(study),
        beside=_worst_in_words(study) if "worst" in study.figures else "",
        made_by=made_by,
    )


def _worst_in_words(study: Study) -> str:
    """Nothing if no policy flies under the first condition."""
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
    """What the study's figures of whole flights and of rates show. Raises OSError, ValueError."""
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
        said = message_bytes(load_bundle(study.sized_by), 2)
        results = rates.results_of(flown.results, [_name(study, draw) for draw in study.draws])
        sections.append(rates.rates(results, said, folder))
    return sections


def _name(study: Study, draw: Draw) -> str:
    """Of one flight among those of a policy under a condition."""
    world, trial = f"world {draw.world}", f"trial {draw.trial + 1}"
    if study.trials == 1:
        return world
    return trial if study.worlds == 1 else f"{world}, {trial}"


def _by_world(
    study: Study, records: Mapping[PlannedFlight, FlightRecord]
) -> dict[str, dict[str, FlightRecord]]:
    """All flights by world, and who flew; of several trainings the first."""
    found: dict[str, dict[str, FlightRecord]] = {}
    for draw in study.draws:
        for condition in study.conditions:
            for policy in study.methods_of(condition):
                is_whole = policy.trained and condition.engine != "point"
                name = WHOLE_ROBOTS if is_whole else policy.name
                flight = next(study.flights_of(policy, condition, draw))
                found.setdefault(_name(study, draw), {}).setdefault(name, records[flight])
    return found


def rows_of(told: Mapping[str, Any]) -> list[list[object]]:
    """The CSV's: a heading, and a row for each condition, policy, training and world."""
    rows: list[list[object]] = [
        ["condition", "method", "training", "world", "cost_over_first", "over_clairvoyant"]
    ]
    for condition in told["conditions"]:
        for result in condition["results"]:
            costs, over = (result["by_world"][key] for key in ("final", "over_clairvoyant"))
            rows += [
                [condition["name"], result["name"], training, told["first_world"] + world, *both]
                for training, of_training in enumerate(zip(costs, over, strict=True))
                for world, both in enumerate(zip(*of_training, strict=True))
            ]
    return rows


def draw_conditions(
    results: Mapping[Condition, Sequence[MethodResult]],
    folder: Path,
    chosen: Sequence[Figure] = USUAL_FIGURES,
) -> list[Picture]:
    """The figures of all conditions among those that are chosen. Raises OSError."""
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
    tell: Tell = lambda *_: None,
) -> None:
    """The worst worlds of each policy under the first condition, flown again. Raises OSError.

    Pictures that are there of the same flights stay.
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
        newest = [its for its in drawn.lines if its["picture"] == line["picture"]][-1:]
        if newest != [line] or not path.with_suffix(".png").exists():
            missing.append((name, path, line, pair))
    flights = list(dict.fromkeys(flight for *_, pair in missing for flight in pair))
    flown: dict[PlannedFlight, FlightRecord] = {}
    of = len(flights) + len(missing)
    for flight, record in fly_all(records_of, flights, pool):
        flown[flight] = record
        tell(len(flown), of)
    for done, (name, path, line, (own, best)) in enumerate(missing, 1):
        style.save(snapshots_and_costs({name: flown[own], CLAIRVOYANT: flown[best]}), path)
        drawn.add(line)
        tell(len(flown) + done, of)
