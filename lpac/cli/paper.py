"""`lpac paper`: the paper's experiments, repeated."""

import json
import platform
import shlex
from contextlib import closing
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import (
    DEFAULT_BUNDLE,
    AsJson,
    Px4,
    Ray,
    VehicleKind,
    check_px4,
    folder_lock,
    found,
    pool,
    pool_for,
)
from lpac.cli.printing import print_table, progress_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from edge.policy.bundle import Bundle as LoadedBundle
    from lpac.analysis.flight import FlightRecord
    from lpac.paper.asynchrony import TimingResult
    from lpac.sim.cores import Pool
    from lpac.sim.experiment import SimulatedFlight
    from lpac.sim.scenario import Scenario

app = new_app("paper", "Repeat the paper's experiments, and run some that its arguments call for.")

_OUT = Path("out/paper")
_E1_WORLDS, _E2_TRIALS, _WORLD = 3, 3, 0
# Of `async`. A flight in real time takes two minutes.
_WORLDS = {
    VehicleKind.POINT: 50, VehicleKind.SIMULATED: 8, VehicleKind.MAVLINK: 1, VehicleKind.PX4: 1,
}  # fmt: skip
_QUICK_WORLDS = {**_WORLDS, VehicleKind.POINT: 4, VehicleKind.SIMULATED: 2}
# Enough to see whether slower or faster is better.
_QUICK_HZ = {"perception_hz": (1.0, 5.0), "policy_hz": (0.5, 2.5, 10.0)}
_QUICK_DELAYS_S = (0.0, 0.8)
_QUICK_SET_UPS = ("field", "n3", "n32", "features-20", "range-128")
_VEHICLES = {
    VehicleKind.SIMULATED: "simulated PX4s on one simulated clock",
    VehicleKind.MAVLINK: "simulated PX4s, a program for each robot, in real time",
    VehicleKind.PX4: "real PX4s that run as software, a program for each robot",
}
_QUICKLY = {False: "", True: " --quick"}
_TRANSFER_WORLDS = {**_WORLDS, VehicleKind.POINT: 20, VehicleKind.SIMULATED: 4}
_QUICK_TRANSFER_WORLDS = {**_WORLDS, VehicleKind.POINT: 2, VehicleKind.SIMULATED: 1}
# They take hours.
_TOO_LARGE = ("n300", "n1000")
# Robots, repetitions, s.
_QUICK_NETWORK = (3, 1, 8.0)


Bundle = Annotated[Path, typer.Option(help="Policy bundle.")]
FlownBundle = Annotated[
    Path | None,
    typer.Option(
        callback=found,
        help="Policy bundle, the shipped one if not given; with --logs the one that flew, which "
        "says what baselines see and how far robots hear.",
    ),
]
Vehicle = Annotated[
    VehicleKind, typer.Option(help="Points, or whole robots, as `lpac sim` has them.")
]
Logs = Annotated[
    Path | None,
    typer.Option(
        callback=found, help="Folder of flight logs, such as a field day's; nothing is flown."
    ),
]
World = Annotated[
    int | None,
    typer.Option(help=f"Number of the world, of the validation set; {_WORLD} if not given."),
]
Trial = Annotated[
    list[str] | None,
    typer.Option("--trial", metavar="NAME", help="--logs: only this mission; may be repeated."),
]
WorldFile = Annotated[
    Path | None, typer.Option(help="--logs: the world file, if it is not beside the logs.")
]
Namespaces = Annotated[
    str | None,
    typer.Option(
        metavar="NAME,NAME...", help="For the network experiment, as in `lpac bench network`."
    ),
]
Quick = Annotated[bool, typer.Option("--quick", help="A small version that takes minutes.")]
Out = Annotated[
    Path | None,
    typer.Option(help="Folder for figures, data and README.md; out/paper/NAME if none."),
]


@app.command()
def e1(
    *,
    bundle: FlownBundle = None,
    worlds: Annotated[
        int | None,
        typer.Option(
            "--worlds", "-k", help=f"How many of the validation set; {_E1_WORLDS} if not given."
        ),
    ] = None,
    vehicle: Vehicle = VehicleKind.POINT,
    px4: Px4 = None,
    logs: Logs = None,
    trial: Trial = None,
    world_file: WorldFile = None,
    ray: Ray = None,
    as_json: AsJson = False,
    out: Out = None,
) -> None:
    """Transferability: unseen worlds from the same starts, beside baselines."""
    from lpac.paper.experiments import (
        WHOLE_ROBOTS,
        pads_of,
        transferability,
        whole_transferability,
    )
    from lpac.paper.report import POINTS, WHOLE_BESIDE_POINTS, write_transferability

    _check_options(vehicle, px4, logs, trial, world_file, {"--worlds": worlds, "--ray": ray})
    worlds = _E1_WORLDS if worlds is None else worlds
    _at_least(1, worlds, "--worlds")
    folder = out or _OUT / "e1"
    records: dict[str, dict[str, FlightRecord]]
    if logs is not None:
        trials = _logged(logs, trial, world_file, bundle)
        records, how = _beside_points(trials, bundle or DEFAULT_BUNDLE)
        made_by = _made_from_logs("e1", logs, trial, world_file, bundle, trials)
    else:
        cores, flown_by = pool(ray), bundle or DEFAULT_BUNDLE
        is_whole = vehicle is not VehicleKind.POINT
        plan = whole_transferability(flown_by, worlds) if is_whole else {}
        points = transferability(worlds, pads_of(flown_by) if is_whole else None)
        seeds = {world: of_world["lpac"].seed for world, of_world in points.items()}
        seeds |= {f"{world}, {WHOLE_ROBOTS}": scenario.seed for world, scenario in plan.items()}
        made_by = _made_by(f"e1 -k {worlds}{_option(vehicle)}", [flown_by], seeds)
        how = WHOLE_BESIDE_POINTS.format(vehicles=_VEHICLES[vehicle]) if is_whole else POINTS
        folder.mkdir(parents=True, exist_ok=True)
        whole = _fly_whole(plan, flown_by, vehicle, px4, cores, folder) if plan else {}
        named = {(w, name): one for w, of_world in points.items() for name, one in of_world.items()}
        flown = dict(zip(named, _fly(list(named.values()), flown_by, cores), strict=True))
        records = {world: {WHOLE_ROBOTS: record} for world, record in whole.items()}
        for (world, name), flight in flown.items():
            records.setdefault(world, {})[name] = flight.record
    told = write_transferability(records, folder, made_by, how)
    _tell(
        told, folder, as_json=as_json,
        lines=[
            f"{world}: "
            + ", ".join(f"{name} {record.normalized[-1]:.3f}" for name, record in its.items())
            for world, its in records.items()
        ],
    )  # fmt: skip


@app.command()
def e2(
    *,
    bundle: FlownBundle = None,
    trials: Annotated[
        int | None, typer.Option(help=f"How many trials; {_E2_TRIALS} times if not given.")
    ] = None,
    world: World = None,
    vehicle: Vehicle = VehicleKind.POINT,
    px4: Px4 = None,
    logs: Logs = None,
    trial: Trial = None,
    world_file: WorldFile = None,
    ray: Ray = None,
    as_json: AsJson = False,
    out: Out = None,
) -> None:
    """Repeatability: one world again and again, starts and GPS a little off."""
    from lpac.paper.experiments import repeatability, who_is_missing, whole_repeatability
    from lpac.paper.report import LOGS, POINTS, WHOLE, write_repeatability

    of_flights = {"--trials": trials, "--world": world, "--ray": ray}
    _check_options(vehicle, px4, logs, trial, world_file, of_flights)
    trials = _E2_TRIALS if trials is None else trials
    world = _WORLD if world is None else world
    _at_least(2, trials, "--trials")
    folder = out or _OUT / "e2"
    if logs is not None:
        records = _logged(logs, trial, world_file, bundle)
        _at_least(2, len(records), f"missions in {logs}:")
        made_by, how = _made_from_logs("e2", logs, trial, world_file, bundle, records), LOGS
    else:
        cores, flown_by = pool(ray), bundle or DEFAULT_BUNDLE
        command = f"e2 --trials {trials} --world {world}{_option(vehicle)}"
        if vehicle is VehicleKind.POINT:
            plan, how = repeatability(trials, world), POINTS
            made_by = _made_by(command, [flown_by], {n: one.seed for n, one in plan.items()})
            folder.mkdir(parents=True, exist_ok=True)
            flown = _fly(list(plan.values()), flown_by, cores)
            records = {name: flight.record for name, flight in zip(plan, flown, strict=True)}
        else:
            whole = whole_repeatability(flown_by, trials, world)
            how = WHOLE.format(vehicles=_VEHICLES[vehicle])
            made_by = _made_by(command, [flown_by], {n: one.seed for n, one in whole.items()})
            folder.mkdir(parents=True, exist_ok=True)
            records = _fly_whole(whole, flown_by, vehicle, px4, cores, folder)
    told = write_repeatability(records, folder, made_by, how)
    spread = told["spread"]
    _tell(
        told, folder, as_json=as_json,
        lines=[
            f"cost after {spread['end_s']:.0f} s",
            *(f"{name}: {one['final']:.3f}" for name, one in told["trials"].items()),
            f"mean {spread['final_mean']:.3f}, standard deviation {spread['final_deviation']:.3f}",
            *who_is_missing(spread),
        ],
    )  # fmt: skip


def _check_options(
    vehicle: VehicleKind,
    px4: Path | None,
    logs: Path | None,
    trial: "Sequence[str] | None",
    world_file: Path | None,
    of_flights: "Mapping[str, object]",
) -> None:
    """An option that would do nothing is a mistake: with logs each that is given `of_flights`."""
    given = [option for option, value in of_flights.items() if value is not None]
    if logs is not None and given:
        raise ValueError(f"{given[0]} does nothing with --logs")
    if logs is not None and vehicle is not VehicleKind.POINT:
        raise ValueError("--vehicle does nothing with --logs")
    if logs is not None and px4 is not None:
        raise ValueError("--px4 does nothing with --logs")
    check_px4(vehicle, px4)
    if logs is None and (trial or world_file is not None):
        raise ValueError(f"--{'trial' if trial else 'world-file'} does nothing without --logs")


def _logged(
    logs: Path, trial: "Sequence[str] | None", world_file: Path | None, bundle: Path | None
) -> "dict[str, FlightRecord]":
    """The missions in the logs below a folder, by name. Raises ValueError if one has no cost."""
    from lpac.analysis.examination import Wanted, examine

    wanted = Wanted(
        missions=tuple(trial or ()), world=world_file, bundle=bundle, world_option="--world-file"
    )
    examined = examine([logs], wanted)
    for record in examined.records:
        if not len(record.normalized):
            why = [note for note in examined.notes if note.startswith(f"{record.name}: ")]
            others = "; or choose other missions with --trial" if len(examined.records) > 1 else ""
            raise ValueError("; ".join(why or [f"{record.name}: no cost is known"]) + others)
    for note in examined.notes:
        typer.echo(f"note: {note}", err=True)
    return {record.name: record for record in examined.records}


def _beside_points(
    trials: "Mapping[str, FlightRecord]", bundle: Path
) -> "tuple[dict[str, dict[str, FlightRecord]], str]":
    """E1 of logs: each mission that the bundle flew beside the baselines; and how."""
    from edge.policy.bundle import load_bundle
    from lpac.paper.experiments import beside
    from lpac.paper.report import LOGS, LOGS_BESIDE_POINTS

    records = {name: {"flight": record} for name, record in trials.items()}
    own = [load_bundle(bundle).id]
    others = [name for name, record in trials.items() if _flown_by({name: record}) != own]
    if others:
        typer.echo(
            f"note: {bundle} is not what flew {', '.join(others)}, so what baselines would see "
            "there is not known: they are left out; give the bundle that flew with --bundle",
            err=True,
        )
    named = {
        (trial, name): scenario
        for trial, record in trials.items()
        if trial not in others
        for name, scenario in beside(record).items()
    }
    if not named:
        return records, LOGS
    flown = _fly(list(named.values()), bundle, pool(None))
    for (trial, name), flight in zip(named, flown, strict=True):
        records[trial][name] = flight.record
    return records, LOGS_BESIDE_POINTS


def _fly_whole(
    plan: "Mapping[str, Scenario]",
    bundle: Path,
    vehicle: VehicleKind,
    px4: Path | None,
    cores: "Pool",
    folder: Path,
) -> "dict[str, FlightRecord]":
    """Whole robots; in real time one flight after another, whose logs stay in `folder`."""
    from lpac.paper import flown

    records: dict[str, FlightRecord] = {}
    with progress_of("flights") as progress:
        task = progress.add_task("", total=len(plan))
        if vehicle is VehicleKind.SIMULATED:
            scenarios = list(plan.values())
            with closing(flown.fly_whole(scenarios, bundle.resolve(), cores)) as told:
                by_number = {}
                for number, record in told:
                    by_number[number] = record
                    progress.update(task, advance=1)
            return {name: by_number[number] for number, name in enumerate(plan)}
        for name, scenario in plan.items():
            its = folder / name.replace(" ", "-")
            records[name] = flown.fly_programs(scenario, its, bundle, px4)
            progress.update(task, advance=1)
    return records


@app.command()
def e3(
    *,
    bundle: FlownBundle = None,
    world: World = None,
    vehicle: Annotated[
        VehicleKind, typer.Option(help="point; or whole robots, some of which a pilot takes.")
    ] = VehicleKind.POINT,
    px4: Px4 = None,
    logs: Logs = None,
    trial: Trial = None,
    world_file: WorldFile = None,
    ray: Ray = None,
    as_json: AsJson = False,
    out: Out = None,
) -> None:
    """Perturbation: robots are taken away at steady state, and brought back."""
    from lpac.paper.experiments import (
        absences_of,
        perturbation,
        perturbed,
        perturbed_by,
        whole_perturbation,
    )
    from lpac.paper.report import TAKEN_LOGS, TAKEN_POINTS, TAKEN_WHOLE, write_perturbation

    _check_options(vehicle, px4, logs, trial, world_file, {"--world": world, "--ray": ray})
    world = _WORLD if world is None else world
    folder, flown_by = out or _OUT / "e3", bundle or DEFAULT_BUNDLE
    command = f"e3 --world {world}{_option(vehicle)}"
    if logs is not None:
        trials = _logged(logs, trial, world_file, bundle)
        if len(trials) > 1:
            raise ValueError(f"{logs}: has {', '.join(trials)}: choose one mission with --trial")
        [record] = trials.values()
        what = perturbed_by(record, absences_of(record), _range_m(flown_by, _flown_by(trials)))
        made_by, how = _made_from_logs("e3", logs, trial, world_file, bundle, trials), TAKEN_LOGS
    elif vehicle is VehicleKind.POINT:
        plan, cores, how = perturbation(world), pool(ray), TAKEN_POINTS
        made_by = _made_by(command, [flown_by], {"flight": plan.seed})
        folder.mkdir(parents=True, exist_ok=True)
        [flight] = _fly([plan], flown_by, cores)
        what = perturbed(flight)
    else:
        scenario = whole_perturbation(flown_by, world)
        made_by = _made_by(command, [flown_by], {"flight": scenario.seed})
        how = TAKEN_WHOLE.format(vehicles=_VEHICLES[vehicle])
        range_m = _range_m(flown_by)
        folder.mkdir(parents=True, exist_ok=True)
        [record] = _fly_whole(
            {"flight": scenario}, flown_by, vehicle, px4, pool(None), folder
        ).values()
        what = perturbed_by(record, absences_of(record), range_m)
    told = write_perturbation(what, folder, made_by, how)
    _tell(
        told, folder, as_json=as_json,
        lines=[
            f"robot {phase['robot']} {'away' if phase['away'] else 'back'}: "
            f"{phase['cost_before']:.3f} before, {phase['cost_worst']:.3f} at worst, "
            f"{phase['cost_end']:.3f} in the end, settled after {phase['settled_s']:.0f} s"
            for phase in told["phases"]
        ],
    )  # fmt: skip


def _range_m(path: Path, flown: "Sequence[str] | None" = None) -> float:
    """How far the bundle's robots hear each other in the field's scale.

    Raises ValueError if it is none of `flown`, ids of bundles.
    """
    from lpac.sim.description import FIELD_SCALE

    bundle = _bundle_that_flew(path, flown, "which says how far robots hear each other")
    perception = bundle.manifest.perception
    assert perception is not None
    return perception.communication_range / FIELD_SCALE.env_scale


def _bundle_that_flew(path: Path, flown: "Sequence[str] | None", why: str) -> "LoadedBundle":
    """Raises ValueError if others of `flown`, ids of bundles, flew, or it cannot fly."""
    from edge.policy.bundle import load_bundle

    bundle = load_bundle(path)
    if bundle.manifest.perception is None:
        raise ValueError(f"{path}: has no perception: it cannot fly")
    if flown is not None and len(flown) > 1:
        raise ValueError(
            f"{' and '.join(its[:16] for its in flown)} flew: choose missions of one bundle with "
            "--trial"
        )
    if flown is not None and bundle.id not in flown:
        raise ValueError(
            f"{path}: is not what flew, {flown[0][:16]}: give that with --bundle, {why}"
        )
    return bundle


def _at_least(least: int, value: int, option: str) -> None:
    if value < least:
        raise ValueError(f"{option} {value}: must be at least {least}")


def _option(vehicle: VehicleKind) -> str:
    return "" if vehicle is VehicleKind.POINT else f" --vehicle {vehicle.value}"


def _made_by(
    command: str,
    bundles: "Sequence[Path]",
    seeds: "Mapping[str, int] | None" = None,
    worlds: int | None = None,
) -> dict[str, str]:
    """What made an experiment: its command, its policies, what was drawn, and versions.

    Of the first `worlds` of the validation set the seeds are those of their numbers.
    """
    from edge.policy.bundle import load_bundle

    named = "".join(f" --bundle {path}" for path in bundles if path != DEFAULT_BUNDLE)
    bundle_ids = [load_bundle(path).id for path in bundles]
    return _provenance(command + named, bundle_ids, seeds or {}, worlds)


def _made_from_logs(
    name: str,
    logs: Path,
    trial: "Sequence[str] | None",
    world_file: Path | None,
    bundle: Path | None,
    records: "Mapping[str, FlightRecord]",
) -> dict[str, str]:
    options = [
        ("--logs", str(logs)),
        *(("--trial", its) for its in trial or ()),
        *(("--world-file", str(its)) for its in [world_file] if its is not None),
        *(("--bundle", str(its)) for its in [bundle] if its is not None),
    ]
    command = " ".join([name, *(f"{option} {shlex.quote(value)}" for option, value in options)])
    return _provenance(command, _flown_by(records), {})


def _flown_by(records: "Mapping[str, FlightRecord]") -> list[str]:
    """The ids of the policies' bundles."""
    robots = [robot for record in records.values() for robot in record.robots]
    return sorted({said.bundle_id for robot in robots for said in robot.said})


def _provenance(
    command: str,
    bundle_ids: "Sequence[str]",
    seeds: "Mapping[str, int]",
    worlds: int | None = None,
) -> dict[str, str]:
    import edge
    import lpac
    from lpac.sim.kept import code_digest

    told = {
        "bundle": ", ".join(bundle_ids),
        "seeds": ", ".join(f"{name} {seed}" for name, seed in seeds.items()),
        "worlds": f"0 to {worlds - 1} of the validation set, and their seeds" if worlds else "",
    }
    return {
        "command": f"lpac paper {command}",
        **{what: value for what, value in told.items() if value},
        "lpac-edge": f"{version('lpac-edge')}, code {code_digest(edge, lpac)[:12]}",
        "python": platform.python_version(),
        **{package: version(package) for package in ("numpy", "onnxruntime")},
    }


def _fly(scenarios: "Sequence[Scenario]", bundle: Path, cores: "Pool") -> "list[SimulatedFlight]":
    """All of them, in their order."""
    from lpac.paper.flown import fly_all

    flown: dict[int, SimulatedFlight] = {}
    with (
        progress_of("flights") as progress,
        closing(fly_all(scenarios, bundle.resolve(), cores)) as told,
    ):
        task = progress.add_task("", total=len(scenarios))
        for number, flight in told:
            flown[number] = flight
            progress.update(task, advance=1)
    return [flown[number] for number in range(len(scenarios))]


def _tell(told: dict[str, object], folder: Path, *, lines: "Sequence[str]", as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(told, indent=2))
        return
    typer.echo("\n".join(lines))
    typer.echo(f"\nsee {folder}: README.md, figures, and the data")


@app.command("async")
def asynchrony(
    *,
    bundle: FlownBundle = None,
    worlds: Annotated[
        int | None,
        typer.Option(
            "--worlds",
            "-k",
            help="How many of the validation set, from the first on; if not given, "
            f"{_WORLDS[VehicleKind.POINT]} for points, {_WORLDS[VehicleKind.SIMULATED]} for whole "
            "robots on a simulated clock, 1 in real time.",
        ),
    ] = None,
    vehicle: Vehicle = VehicleKind.POINT,
    px4: Px4 = None,
    logs: Logs = None,
    trial: Trial = None,
    world_file: WorldFile = None,
    quick: Quick = False,
    ray: Ray = None,
    as_json: AsJson = False,
    out: Out = None,
) -> None:
    """Rates of perception and of messages, in step or not, and late messages: what they cost."""
    from lpac.evaluate.evaluation import TrainedBundle
    from lpac.evaluate.flights import KeptFlights
    from lpac.paper.asynchrony import AsynchronyPlan, Flown, results_of
    from lpac.paper.asynchrony import as_json as to_json
    from lpac.paper.asynchrony_report import write_report
    from lpac.paper.repeated import sizes_of
    from lpac.paper.report import EXACT_POINTS, LOGS_BY_RATES, WHOLE_IN_TRUTH

    given = {"--worlds": worlds, "--quick": quick or None, "--ray": ray}
    _check_options(vehicle, px4, logs, trial, world_file, given)
    folder, flown_by = out or _OUT / "async", bundle or DEFAULT_BUNDLE
    if logs is not None:
        trials = _logged(logs, trial, world_file, bundle)
        loaded = _bundle_that_flew(flown_by, _flown_by(trials), "which says how much robots say")
        results, count = _by_rates(trials)
        flown = Flown(loaded.id, sizes_of(loaded).of_two, "logs", None, count)
        made_by, how = (
            _made_from_logs("async", logs, trial, world_file, bundle, trials),
            LOGS_BY_RATES,
        )
        folder.mkdir(parents=True, exist_ok=True)
    else:
        loaded = _bundle_that_flew(flown_by, None, "")
        count = worlds if worlds is not None else (_QUICK_WORLDS if quick else _WORLDS)[vehicle]
        plan = AsynchronyPlan(
            bundle=TrainedBundle(str(flown_by.resolve()), loaded.id),
            message_bytes=sizes_of(loaded).of_two,
            world_set="validation",
            worlds=count,
            robot=vehicle.value,
            px4_build="" if px4 is None else str(px4.resolve()),
            **({**_QUICK_HZ, "delays_s": _QUICK_DELAYS_S} if quick else {}),
        )
        with folder_lock("the experiment", folder):
            flights, costs = plan.flights(), {}
            with (
                progress_of("flights") as progress,
                closing(KeptFlights(folder).fly(flights, pool_for(vehicle, ray))) as told,
            ):
                task = progress.add_task("", total=len(flights))
                for flight, cost in told:
                    costs[flight] = cost
                    progress.update(task, advance=1)
        results, flown = results_of(plan, costs), plan.flown
        command = f"async -k {count}{_option(vehicle)}{_QUICKLY[quick]}"
        made_by = _made_by(command, [flown_by], worlds=count)
        how = EXACT_POINTS
        if vehicle is not VehicleKind.POINT:
            how = WHOLE_IN_TRUTH.format(vehicles=_VEHICLES[vehicle])
    write_report(flown, results, folder, made_by, how)
    if as_json:
        typer.echo(json.dumps(to_json(flown, results), indent=2))
        return
    _show(results)
    typer.echo(f"\nsee {folder}: README.md, figures, async.csv, async.json")


def _by_rates(trials: "Mapping[str, FlightRecord]") -> "tuple[list[TimingResult], int]":
    """What the missions came to by their rates, and of how many; says which are left out."""
    from lpac.paper.asynchrony import TIMES_S, is_comparable, results_of_logs

    for name, record in trials.items():
        if not is_comparable(record):
            why = (
                "its robots' rates differ, or are not in their logs"
                if record.rates is None
                else f"it lasted {record.curve_time_s[-1]:.0f} s, less than {TIMES_S[-1]:g}"
            )
            typer.echo(f"note: {name} is left out: {why}", err=True)
    return results_of_logs(trials), sum(map(is_comparable, trials.values()))


@app.command()
def transfer(
    *,
    bundles: Annotated[
        list[Path] | None,
        typer.Option(
            "--bundle",
            help="Policy bundle; may be repeated. The shipped one if none; with --logs the one "
            "that flew.",
        ),
    ] = None,
    worlds: Annotated[
        int | None,
        typer.Option(
            "--worlds",
            "-k",
            help="How many of the validation set; if not given, 20 for points (2 with --quick), 4 "
            "for whole robots on a simulated clock (1 with --quick), 1 in real time.",
        ),
    ] = None,
    set_ups: Annotated[
        list[str] | None,
        typer.Option(
            "--set-up", metavar="NAME", help="Only this one (docs/research.md); may be repeated."
        ),
    ] = None,
    vehicle: Annotated[
        VehicleKind,
        typer.Option(
            help="Points, or also whole robots as `lpac sim` has them, where no more than 30 fly."
        ),
    ] = VehicleKind.POINT,
    px4: Px4 = None,
    logs: Logs = None,
    trial: Trial = None,
    world_file: WorldFile = None,
    quick: Quick = False,
    ray: Ray = None,
    as_json: AsJson = False,
    out: Out = None,
) -> None:
    """Other numbers of robots, features and ranges: `lpac evaluate` in the paper's set-ups."""
    from lpac.cli.evaluate import evaluate
    from lpac.paper.report import EXACT_POINTS, WHOLE_TRANSFERRED, write_transfer

    given = {"--worlds": worlds, "--set-up": set_ups, "--quick": quick or None, "--ray": ray}
    _check_options(vehicle, px4, logs, trial, world_file, given)
    folder, flown = out or _OUT / "transfer", bundles or [DEFAULT_BUNDLE]
    if logs is not None:
        _transfer_of_logs(logs, trial, world_file, bundles, folder, as_json=as_json)
        return
    names, by_vehicle = _set_ups(set_ups, vehicle, quick=quick), _TRANSFER_WORLDS
    if quick:
        by_vehicle = _QUICK_TRANSFER_WORLDS
    count = worlds if worlds is not None else by_vehicle[vehicle]
    chosen = "".join(f" --set-up {name}" for name in set_ups or ())
    command = f"transfer{_option(vehicle)} -k {count}{chosen}{_QUICKLY[quick]}"
    made_by, how = _made_by(command, flown, worlds=count), EXACT_POINTS
    if vehicle is not VehicleKind.POINT:
        how = WHOLE_TRANSFERRED.format(vehicles=_VEHICLES[vehicle])
    evaluate(
        methods=[str(bundle) for bundle in flown],
        set_ups=names,
        worlds=count,
        vehicle=vehicle,
        px4=px4,
        baselines=["clairvoyant-cvt"],
        ray=ray,
        as_json=as_json,
        out=folder,
    )
    write_transfer(json.loads((folder / "evaluation.json").read_text()), folder, made_by, how)


def _set_ups(chosen: list[str] | None, vehicle: VehicleKind, *, quick: bool) -> list[str]:
    """In which it flies: those that were chosen, or of the paper's what the vehicles can."""
    from lpac.evaluate.worlds import SET_UPS
    from lpac.sim.fleet.layout import MAX_ROBOTS

    if chosen:
        return chosen
    names = [*_QUICK_SET_UPS] if quick else [name for name in SET_UPS if name not in _TOO_LARGE]
    if vehicle is VehicleKind.POINT:
        return names
    return [name for name in names if SET_UPS[name].robots <= MAX_ROBOTS]


def _transfer_of_logs(
    logs: Path,
    trial: "Sequence[str] | None",
    world_file: Path | None,
    bundles: "Sequence[Path] | None",
    folder: Path,
    *,
    as_json: bool,
) -> None:
    from lpac.evaluate.evaluation import CLAIRVOYANT, TrainedBundle
    from lpac.evaluate.report import write_results
    from lpac.paper.experiments import beside
    from lpac.paper.report import LOGS_BESIDE_POINTS, write_transfer
    from lpac.paper.transfer import as_json as to_json
    from lpac.paper.transfer import results_of_logs

    if bundles and len(bundles) > 1:
        raise ValueError("--logs: one bundle flew, so give --bundle once")
    bundle = bundles[0] if bundles else None
    trials, flown_by = _logged(logs, trial, world_file, bundle), bundle or DEFAULT_BUNDLE
    loaded = _bundle_that_flew(flown_by, _flown_by(trials), "which says what baselines see")
    scenarios = {name: beside(record) for name, record in trials.items()}
    for name, of_trial in scenarios.items():
        if not of_trial:
            raise ValueError(f"{name}: nobody was in the air as it began: choose other missions")
    flown = _fly([its[CLAIRVOYANT] for its in scenarios.values()], flown_by, pool(None))
    clairvoyant = {name: one.record for name, one in zip(scenarios, flown, strict=True)}
    trained = TrainedBundle(str(flown_by.resolve()), loaded.id)
    results = results_of_logs(trials, clairvoyant, trained)
    folder.mkdir(parents=True, exist_ok=True)
    told = to_json(results, trained)
    write_results(told, results, folder)
    made_by = _made_from_logs("transfer", logs, trial, world_file, bundle, trials)
    write_transfer(told, folder, made_by, LOGS_BESIDE_POINTS)
    _tell(
        told, folder, as_json=as_json,
        lines=[
            f"{condition.name}: {own.final.mean():.3f}, x "
            f"{own.final.mean() / own.clairvoyant.mean():.2f} clairvoyant Lloyd's"
            for condition, (own, _) in results.items()
        ],
    )  # fmt: skip


@app.command()
def network(
    *,
    namespaces: Namespaces = None,
    quick: Quick = False,
    as_json: AsJson = False,
    out: Out = None,
) -> None:
    """Table I, and throughput by number of robots: `lpac bench network` with what is installed."""
    from lpac.cli.bench import network as measure
    from lpac.middleware.kinds import MIDDLEWARES
    from lpac.paper.report import write_network

    folder = out or _OUT / "network"
    robots, repetitions, seconds = _QUICK_NETWORK if quick else (None, None, None)
    measure(
        middlewares=[name for name, its in MIDDLEWARES.items() if its.version() is not None],
        robots=robots,
        repetitions=repetitions,
        seconds=seconds,
        namespaces=namespaces,
        as_json=as_json,
        out=folder,
    )
    made_by = _made_by(f"network{_of_namespaces(namespaces)}{_QUICKLY[quick]}", [])
    write_network(json.loads((folder / "network.json").read_text()), folder, made_by)


@app.command("all")
def everything(
    *,
    bundle: Bundle = DEFAULT_BUNDLE,
    quick: Quick = False,
    namespaces: Namespaces = None,
    ray: Ray = None,
    out: Out = None,
) -> None:
    """All of them, and one page: each claim of the paper beside the result here.

    Whole robots fly e1, e2 and e3, or points with --quick. Results that were made with the same
    bundle and code are reused.
    """
    from edge.policy.bundle import load_bundle
    from lpac.cli.bench import require_namespaces
    from lpac.paper.files import MADE_FOR_ALL
    from lpac.paper.repeated import write_page

    folder = out or _OUT
    loaded = load_bundle(bundle)
    # Known before hours of flights.
    require_namespaces(namespaces, _QUICK_NETWORK[0] if quick else None)
    vehicle = VehicleKind.POINT if quick else VehicleKind.SIMULATED
    flying: dict[str, Callable[[Path], None]] = {
        "e1": lambda its: e1(bundle=bundle, vehicle=vehicle, ray=ray, out=its),
        "e2": lambda its: e2(bundle=bundle, vehicle=vehicle, ray=ray, out=its),
        "e3": lambda its: e3(bundle=bundle, vehicle=vehicle, ray=ray, out=its),
        "transfer": lambda its: transfer(bundles=[bundle], quick=quick, ray=ray, out=its),
        "async": lambda its: asynchrony(bundle=bundle, quick=quick, ray=ray, out=its),
        "network": lambda its: network(quick=quick, namespaces=namespaces, out=its),
    }
    made_by = {}
    for name, make in flying.items():
        its = folder / name
        option = _option(vehicle) if name in ("e1", "e2", "e3") else _QUICKLY[quick]
        if name == "network":
            option = _of_namespaces(namespaces) + option
        made_by[name] = _made_by(f"{name}{option}", [] if name == "network" else [bundle])
        kept = its / MADE_FOR_ALL
        if kept.exists() and json.loads(kept.read_text()) == made_by[name]:
            continue
        typer.echo(f"{name}\n")
        make(its)
        typer.echo()
        kept.write_text(json.dumps(made_by[name]) + "\n")
    typer.echo(f"see {write_page(folder, loaded, made_by)}")


def _of_namespaces(names: str | None) -> str:
    return "" if names is None else f" --namespaces {names}"


def _show(results: "Sequence[TimingResult]") -> None:
    from lpac.paper.asynchrony import TIMES_S

    columns = (
        "perception, Hz", "policy, Hz", "moments", "delay, s",
        *(f"at {time_s:g} s" for time_s in TIMES_S),
    )  # fmt: skip
    rows = []
    for result in results:
        timing = result.timing
        rows.append(
            [f"{timing.perception_hz:g}", f"{timing.policy_hz:g}",
             "the same" if timing.synchronous else "own", f"{timing.delay_s:g}",
             *(f"{mean:.3f}" for mean, _, _ in result.means)]
        )  # fmt: skip
    print_table(columns, rows, right=[*columns[:2], *columns[3:]])
