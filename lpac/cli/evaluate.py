"""`lpac evaluate`: policies and baselines over many worlds, and how surely one is better."""

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import (
    DEFAULT_BUNDLE,
    AsJson,
    Px4,
    Ray,
    VehicleKind,
    check_px4,
    found,
    pool_for,
)
from lpac.cli.printing import BAD, GOOD, print_table, progress_of, styled
from lpac.cli.transport import WifiFile, calibration, link_line, transport_named, wifi_lines

if TYPE_CHECKING:
    from rich.text import Text

    from edge.core.wire import PayloadType
    from lpac.evaluate.evaluation import Condition, Evaluation, Method, MethodResult
    from lpac.evaluate.flights import EvaluationFlight
    from lpac.sim.cores import Pool
    from lpac.sim.experiment import SimulatedFlight

app = new_app()

_OUT = Path("out/evaluate")
_WORST = 10


@app.command()
def evaluate(
    *,
    methods: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[METHOD]...",
            help="Policy bundles, the shipped one if none is given; several trainings of one "
            "method joined by commas; or names of baselines.",
        ),
    ] = None,
    world_set: Annotated[
        str, typer.Option("--set", help="training, validation, or test; look at test only once.")
    ] = "validation",
    worlds: Annotated[
        int, typer.Option("--worlds", "-k", help="How many worlds of it, from the first on.")
    ] = 20,
    duration: Annotated[float, typer.Option(help="Flight time, s.")] = 60.0,
    set_ups: Annotated[
        list[str] | None,
        typer.Option(
            "--set-up",
            metavar="NAME",
            help="Team and world: field (the default), n1 to n1000, paper, features-3, range-64, "
            "and more (docs/research.md); may be repeated.",
        ),
    ] = None,
    transfer: Annotated[
        bool,
        typer.Option(
            help="All set-ups: other numbers of robots at equal density, features and ranges."
        ),
    ] = False,
    losses: Annotated[
        list[float] | None,
        typer.Option("--loss", help="Also with messages lost with this probability."),
    ] = None,
    transports: Annotated[
        list[str] | None,
        typer.Option(
            "--transport",
            metavar="NAME",
            help="Also with the radio that such a team would have, by a model of one Wi-Fi "
            "channel: mesh, router or multicast.",
        ),
    ] = None,
    wifi: WifiFile = None,
    lost: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROBOTS@S", help="Also with robots lost in flight, such as 2@20: two at 20 s."
        ),
    ] = None,
    lags: Annotated[
        list[float] | None,
        typer.Option(
            "--lag", help="Also with robots that respond with this time constant, s; baselines too."
        ),
    ] = None,
    position_errors: Annotated[
        list[float] | None,
        typer.Option(
            "--position-error",
            help="Also with robots that are wrong about where they are: standard deviation, m.",
        ),
    ] = None,
    payloads: Annotated[
        list[str] | None,
        typer.Option(
            "--payload",
            metavar="TYPE",
            help="Also with messages that carry float32 or int8 instead of float16; each --loss "
            "and --transport is then flown with them, too.",
        ),
    ] = None,
    vehicle: Annotated[
        VehicleKind,
        typer.Option(
            help="Also as the field is flown: whole robots, at most 30, as `lpac sim` has them, "
            "and points from the same pads."
        ),
    ] = VehicleKind.POINT,
    px4: Px4 = None,
    baselines: Annotated[
        list[str] | None,
        typer.Option(
            "--baseline", metavar="NAME", help="Only these, and clairvoyant-cvt; else all."
        ),
    ] = None,
    compare: Annotated[
        bool, typer.Option("--compare", help="Say whether the first of two methods is better.")
    ] = False,
    ray: Ray = None,
    as_json: AsJson = False,
    out: Annotated[
        Path,
        typer.Option(help="Folder for evaluation.json, figures, pictures, and what was flown."),
    ] = _OUT,
) -> None:
    """Policies and baselines over many worlds: how well they cover, with confidence intervals."""
    given = methods or [str(DEFAULT_BUNDLE)]
    for path in (part for text in given for part in text.split(",") if "/" in part):
        found(Path(path))
    from lpac.evaluate.evaluation import as_json as to_json
    from lpac.radio.modelled import ModelledRadio
    from lpac.sim.failure import LostRobots

    check_px4(vehicle, px4)
    if compare and len(given) != 2:
        raise ValueError(f"--compare needs two methods; {len(given)} given")
    if losses and transports:
        raise ValueError("--loss and --transport: the model itself says what is lost")
    lost_robots = [LostRobots.parse(text) for text in lost or []]
    calibrated = calibration(wifi, transport=bool(transports))
    lossy: list[dict[str, Any]] = [
        *({"loss": loss} for loss in losses or []),
        *(
            {"radio": ModelledRadio(transport_named(name), calibrated.wifi)}
            for name in dict.fromkeys(transports or [])
        ),
    ]
    changes = [
        *lossy,
        *({"lost": robots} for robots in lost_robots),
        *({"lag_s": lag_s} for lag_s in lags or []),
        *({"position_error_m": error_m} for error_m in position_errors or []),
        *(
            {"payload": payload, **loss}
            for payload in _payload_types(payloads or [])
            for loss in ({}, *lossy)
        ),
        *(
            {"robot": robot}
            for robot in ("point-from-pad", vehicle.value)
            if vehicle is not VehicleKind.POINT
        ),
    ]
    evaluation = _evaluation(
        given, world_set, worlds, duration, set_ups, changes, baselines, px4, transfer=transfer
    )
    # What draws is slow to load, and a bundle that is missing is told by now.
    from lpac.evaluate.report import write_results

    cores = pool_for(vehicle, ray)
    results = _fly(evaluation, cores, out)
    told = to_json(evaluation, results, compared=compare)
    told["test_set_opened"] = _opened(evaluation)
    sources = {name: source._asdict() for name, source in calibrated.sources.items()}
    told["wifi_from"] = sources if transports else None
    write_results(told, results, out)
    _write_worst(evaluation, results, cores, out)
    if as_json:
        typer.echo(json.dumps(told, indent=2))
        return
    _show(told, compared=compare)
    if transports:
        typer.echo("\n".join(["what the model assumes of the Wi-Fi:", *wifi_lines(calibrated)]))
    typer.echo(f"\nsee {out}: evaluation.json, figures, and the worst worlds")


def _payload_types(given: Sequence[str]) -> list["PayloadType"]:
    from edge.core.wire import PAYLOAD_TYPES

    for name in given:
        if name not in PAYLOAD_TYPES:
            raise ValueError(f"--payload {name}: must be one of {', '.join(PAYLOAD_TYPES)}")
    return [known for known in PAYLOAD_TYPES if known in given]


def _evaluation(
    given: Sequence[str],
    world_set: str,
    worlds: int,
    duration_s: float,
    set_ups: list[str] | None,
    changes: Sequence[Mapping[str, Any]],
    baselines: list[str] | None,
    px4: Path | None,
    *,
    transfer: bool,
) -> "Evaluation":
    from lpac.evaluate.evaluation import Condition
    from lpac.evaluate.flights import BASELINES
    from lpac.evaluate.run import make_evaluation
    from lpac.evaluate.worlds import SET_UPS, WORLD_SETS

    chosen_sets = [one for one in WORLD_SETS if one == world_set]
    if not chosen_sets:
        raise ValueError(f"--set {world_set}: must be one of {', '.join(WORLD_SETS)}")
    for name in baselines or ():
        if name not in BASELINES:
            raise ValueError(f"--baseline {name}: must be one of {', '.join(BASELINES)}")
    for name in set_ups or ():
        if name not in SET_UPS:
            raise ValueError(f"--set-up {name}: must be one of {', '.join(SET_UPS)}")
    if transfer and any("robot" in change for change in changes):
        raise ValueError("--transfer has teams that do not fly whole: choose others with --set-up")
    if transfer and set_ups:
        raise ValueError("--transfer flies all set-ups: --set-up does nothing beside it")
    names = _names(given)
    return make_evaluation(
        [_method(text, name) for text, name in zip(given, names, strict=True)],
        baselines=[name for name in BASELINES if not baselines or name in baselines],
        conditions=[
            condition
            for name in (SET_UPS if transfer else set_ups or ["field"])
            for condition in (Condition(name), *(Condition(name, **change) for change in changes))
        ],
        world_set=chosen_sets[0],
        worlds=worlds,
        duration_s=duration_s,
        sizes_from=DEFAULT_BUNDLE,
        px4_build=px4,
    )


def _names(given: Sequence[str]) -> list[str]:
    """Short ones: of each path the last parts, as many as tell it from the others."""
    parts = [[Path(path).resolve().parts for path in text.split(",")] for text in given]
    for depth in range(1, max(len(part) for text in parts for part in text) + 1):
        names = [",".join("/".join(part[-depth:]) for part in text) for text in parts]
        if len(set(names)) == len(set(given)):
            break
    return names


def _method(text: str, name: str) -> "Method":
    """A baseline by its name, or bundles by their paths. Raises BundleError."""
    from lpac.evaluate.evaluation import Method
    from lpac.evaluate.flights import BASELINES
    from lpac.evaluate.run import policy_method

    for baseline in BASELINES:
        if baseline == text:
            return Method(name=baseline, flier=baseline)
    return policy_method(name, *map(Path, text.split(",")))


def _fly(
    evaluation: "Evaluation", cores: "Pool", out: Path
) -> dict["Condition", list["MethodResult"]]:
    from lpac.evaluate.run import evaluate as fly_all

    with progress_of("flights") as progress:
        task = progress.add_task("", total=None)

        def tell(done: int, of: int) -> None:
            progress.update(task, completed=done, total=of)

        return fly_all(evaluation, cores, folder=out, tell=tell)


def _opened(evaluation: "Evaluation") -> dict[str, Any] | None:
    """Of the test set: by whom, when, and how many worlds of it. None if another was looked at."""
    if evaluation.world_set != "test":
        return None
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "bundle_ids": [
            training.bundle_id for method in evaluation.methods for training in method.trainings
        ],
        "worlds": evaluation.worlds,
    }


def _write_worst(
    evaluation: "Evaluation",
    results: Mapping["Condition", Sequence["MethodResult"]],
    cores: "Pool",
    out: Path,
) -> None:
    """Of each policy, under the first condition: its worst worlds, flown again."""
    from lpac.evaluate.evaluation import CLAIRVOYANT, worst_worlds
    from lpac.evaluate.flights import fly_group, groups_of
    from lpac.evaluate.report import write_world

    condition, of_all = next(iter(results.items()))
    clairvoyant = next(r.method for r in of_all if r.method.name == CLAIRVOYANT)
    wanted = {
        (result.method.name, place, world): [
            next(evaluation.flights_of(method, condition, world))
            for method in (result.method, clairvoyant)
        ]
        for result in of_all
        if result.method.trained
        for place, world in enumerate(worst_worlds(result, _WORST), 1)
    }
    flights = list(dict.fromkeys(flight for pair in wanted.values() for flight in pair))
    flown: dict[EvaluationFlight, SimulatedFlight] = {}
    with progress_of("pictures of the worst worlds") as progress:
        task = progress.add_task("", total=len(flights) + len(wanted))
        for group in cores(fly_group, groups_of(flights)) if flights else ():
            flown.update(group)
            progress.update(task, advance=len(group))
        for (name, place, world), pair in wanted.items():
            shown = {str(flight.flier): flown[flight] for flight in pair}
            write_world(
                shown, out / "worst" / name.replace("/", "-") / f"{place:02d}-world-{world}"
            )
            progress.update(task, advance=1)


def _show(told: Mapping[str, Any], *, compared: bool) -> None:
    from lpac.analysis.statistics import VERDICT_RULE

    policies = [method["name"] for method in told["methods"] if method["bundles"]]
    for condition in told["conditions"]:
        typer.echo(
            f"{condition['name']}: {told['worlds']} worlds of the {told['world_set']} set, "
            f"{told['duration_s']:g} s; cost at the end over that at the start\n"
        )
        radio = condition["radio_model"]
        if radio is not None:
            typer.echo(f"{link_line(radio['loss'], radio['delay_s'])}\n")
        of_all = condition["results"]
        print_table(_COLUMNS, [_row(one) for one in of_all], right=_COLUMNS[1:])
        typer.echo(f"\n{_COLUMNS_SAY}")
        of_policies = [one for one in of_all if one["name"] in policies]
        for one in of_policies:
            typer.echo(
                f"\n{one['name']}: {_share(one['fails'])} of the worlds end above "
                f"{told['fails_above']:g} x clairvoyant; in {_share(one['rises_again'])} costs "
                "rise again"
            )
        if of_policies:
            typer.echo()
            rows = [
                [baseline["name"], *(_against(one, baseline["name"]) for one in of_policies)]
                for baseline in of_all
                if baseline not in of_policies
            ]
            print_table(("against", *policies), rows)
            typer.echo(f"\n{VERDICT_RULE}; else they are not told apart")
        if compared:
            _show_verdict(condition["compared"], *told["methods"][:2], worlds=told["worlds"])
        typer.echo()
    opened = told["test_set_opened"]
    if opened is not None:
        typer.echo(
            f"the test set was opened, {opened['worlds']} worlds of it: if you choose by this, "
            "it is no test set any more"
        )


_COLUMNS = (
    "", "mean\nJ / J(0)", "95 %", "p90", "worst", "area", "vs\nclair-\nvoyant", "p90",
    "vs\nbest\nLloyd",
)  # fmt: skip
_COLUMNS_SAY = (
    "J / J(0): cost at the end over that at the start: its mean over the worlds and in which "
    "interval that is, at 95 % confidence; p90: nine worlds of ten end below, worst: the worst "
    "one\n"
    "area: the mean of J / J(0) over the flight, so the area under its curve\n"
    "vs clairvoyant: how many times that of Lloyd's algorithm that knows the world, mean over "
    "mean, and, world by world, p90\n"
    "vs best Lloyd: how many times that of the best of ten such runs, in each world"
)


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


def _against(policy: Mapping[str, Any], baseline: str) -> "Text":
    """Whether better, and in how many worlds it ends above the baseline."""
    above, verdict = policy["above"][baseline], policy["against"][baseline]
    text = {"a": "better", "b": "worse", None: "not told apart"}[verdict["better"]]
    style = {"a": GOOD, "b": BAD, None: ""}[verdict["better"]]
    return styled(f"{text}, above it in {100.0 * above['share']:.3g} %", style)


def _show_verdict(
    verdict: Mapping[str, Any], a: Mapping[str, Any], b: Mapping[str, Any], *, worlds: int
) -> None:
    from lpac.analysis.statistics import Interval95, what_would_tell

    ratio, below = verdict["ratio"], verdict["a_below_b"]
    if verdict["better"] is None:
        said = f"the data do not show whether {a['name']} or {b['name']} is better"
    else:
        better, worse = (a, b) if verdict["better"] == "a" else (b, a)
        said = f"{better['name']} is better than {worse['name']}"
    typer.echo(
        f"\n{said}: cost at the end {ratio[0]:.3f} times (95 %: {ratio[1]:.3f} to {ratio[2]:.3f}), "
        f"lower in {100.0 * below[0]:.3g} % of the worlds ({100.0 * below[1]:.3g} to "
        f"{100.0 * below[2]:.3g})"
    )
    if verdict["better"] is None:
        typer.echo(what_would_tell(Interval95(*verdict["difference"]), worlds))
    if not verdict["of_methods"]:
        typer.echo(
            "that is true of these bundles; it takes three trainings of each, joined by commas, to "
            "say it of the methods"
        )
