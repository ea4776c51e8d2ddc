"""`lpac paper`: the paper's experiments, repeated."""

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lpac.cli.apps import new_app
from lpac.cli.fields import options_of
from lpac.cli.options import (
    DEFAULT_BUNDLE,
    AsJson,
    Px4,
    Ray,
    VehicleKind,
    check_px4,
    found,
    pool,
    require_here,
)
from lpac.cli.study import StudyTask, fly_study, fly_together, show_report

if TYPE_CHECKING:
    from lpac.analysis.flight import FlightRecord

app = new_app("paper", "Repeat the paper's experiments, and run some that its arguments call for.")

_OUT = Path("out/paper")
# By this `lpac paper all` knows what it made itself, and need not make again.
_MADE_FOR_ALL = "made_by.json"
_IN_THE_AIR = ("e1", "e2", "e3", "transfer", "async")
# Robots, repetitions, s.
_QUICK_NETWORK = (3, 1, 8.0)
_Out = Annotated[
    Path | None,
    typer.Option(help="Folder for figures, data and README.md; out/paper/NAME if none."),
]
_Worlds = Annotated[
    int | None,
    typer.Option(
        "--worlds", "-k",
        help="How many of the validation set, from the first on; else as the study has it, "
        "and a fifth of it, or one in real time, for whole robots in `async` and `transfer`.",
    ),
]  # fmt: skip
_World = Annotated[
    int | None, typer.Option(help="Number of the world, of the validation set; else 0.")
]
_Quick = Annotated[bool, typer.Option("--quick", help="A small version that takes minutes.")]
_Namespaces = Annotated[
    str | None,
    typer.Option(
        metavar="NAME,NAME...", help="For the network experiment, as in `lpac bench network`."
    ),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class ExperimentOptions:
    """Options of each experiment: what flies, or which logs tell of it."""

    bundles: Annotated[
        list[Path] | None,
        typer.Option(
            "--bundle",
            help="Policy bundle, the shipped one if not given; with --logs the one that flew, "
            "which says what baselines see and how far robots hear. Of `transfer` several.",
        ),
    ] = None
    vehicle: Annotated[VehicleKind, "Points, or whole robots, as `lpac sim` has them."] = (
        VehicleKind.POINT
    )
    px4: Px4 = None
    logs: Annotated[
        Path | None,
        typer.Option(
            callback=found, help="Folder of flight logs, such as a field day's; nothing is flown."
        ),
    ] = None
    trial: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="--logs: only this mission; may be repeated."),
    ] = None
    world_file: Annotated[Path | None, "--logs: the world file, if it is not beside the logs."] = (
        None
    )
    ray: Ray = None
    as_json: AsJson = False
    out: _Out = None


@app.command()
@options_of(ExperimentOptions)
def e1(flown: ExperimentOptions, *, worlds: _Worlds = None) -> None:
    """Transferability: unseen worlds from the same starts, beside baselines."""
    _experiment("e1", flown, {"worlds": worlds})


@app.command()
@options_of(ExperimentOptions)
def e2(
    flown: ExperimentOptions,
    *,
    trials: Annotated[int | None, typer.Option(help="How many trials; else 3.")] = None,
    world: _World = None,
) -> None:
    """Repeatability: one world again and again, starts and GPS a little off."""
    if trials is not None and trials < 2:
        raise ValueError(f"--trials {trials}: must be at least 2")
    _experiment("e2", flown, {"trials": trials, "first_world": world})


@app.command()
@options_of(ExperimentOptions)
def e3(flown: ExperimentOptions, *, world: _World = None) -> None:
    """Perturbation: robots are taken away at steady state, and brought back."""
    _experiment("e3", flown, {"first_world": world})


@app.command("async")
@options_of(ExperimentOptions)
def asynchrony(flown: ExperimentOptions, *, worlds: _Worlds = None, quick: _Quick = False) -> None:
    """Rates of perception and of messages, in step or not, and late messages: what they cost."""
    _experiment("async", flown, {"worlds": worlds}, quick=quick)


@app.command()
@options_of(ExperimentOptions)
def transfer(
    flown: ExperimentOptions,
    *,
    worlds: _Worlds = None,
    set_ups: Annotated[
        list[str] | None,
        typer.Option(
            "--set-up", metavar="NAME", help="Only this one (docs/research.md); may be repeated."
        ),
    ] = None,
    quick: _Quick = False,
) -> None:
    """Other numbers of robots, features and ranges: `lpac evaluate` in the paper's set-ups."""
    _experiment("transfer", flown, {"worlds": worlds, "set_ups": set_ups}, quick=quick)


_OPTIONS = {"worlds": "--worlds", "trials": "--trials", "first_world": "--world",
            "set_ups": "--set-up"}  # fmt: skip


def _experiment(
    name: str, options: ExperimentOptions, changes: Mapping[str, Any], *, quick: bool = False
) -> None:
    """Fly it, or read it from logs. `changes` are what else was given, or None."""
    given = {key: value for key, value in changes.items() if value is not None}
    _check(name, options, given, quick=quick)
    if options.logs is not None:
        _from_logs(name, options.logs, options)
        return
    task = _task(name, options, given, quick=quick)
    fly_study(task, options.ray, as_json=options.as_json)
    (task.folder / _MADE_FOR_ALL).unlink(missing_ok=True)


def _task(
    name: str, options: ExperimentOptions, given: Mapping[str, Any], *, quick: bool
) -> StudyTask:
    """The experiment, changed as `given`; and the command that repeats it."""
    from lpac.paper.experiments import experiment

    bundles, vehicle = options.bundles or [DEFAULT_BUNDLE], options.vehicle
    changes = dict(given)
    study = experiment(
        name, bundles, engine=vehicle.value, px4_build=options.px4, quick=quick,
        set_ups=changes.pop("set_ups", ()),
    )  # fmt: skip
    words = ["paper", name]
    words += [] if vehicle is VehicleKind.POINT else ["--vehicle", vehicle.value]
    words += [word for key, value in changes.items() for word in (_OPTIONS[key], str(value))]
    words += [word for its in given.get("set_ups", ()) for word in ("--set-up", its)]
    words += [word for its in bundles if its != DEFAULT_BUNDLE for word in ("--bundle", str(its))]
    words += ["--quick"] if quick else []
    return StudyTask(
        name=name, study=replace(study, **changes), folder=options.out or _OUT / name,
        command=shlex.join(words),
    )  # fmt: skip


def _check(name: str, options: ExperimentOptions, given: Mapping[str, Any], *, quick: bool) -> None:
    """Raise ValueError for an option that would do nothing."""
    for path in options.bundles or ():
        found(path)
    if len(options.bundles or ()) > 1 and (name != "transfer" or options.logs is not None):
        raise ValueError("one bundle flew, so give --bundle once")
    if options.logs is not None:
        flying = [_OPTIONS[key] for key in given]
        flying += ["--quick"] if quick else []
        flying += ["--ray"] if options.ray is not None else []
        flying += ["--vehicle"] if options.vehicle is not VehicleKind.POINT else []
        flying += ["--px4"] if options.px4 is not None else []
        if flying:
            raise ValueError(f"{flying[0]} does nothing with --logs")
        return
    check_px4(options.vehicle, options.px4)
    require_here(options.vehicle, options.ray)
    if options.trial or options.world_file is not None:
        option = "--trial" if options.trial else "--world-file"
        raise ValueError(f"{option} does nothing without --logs")


def _from_logs(name: str, logs: Path, options: ExperimentOptions) -> None:
    """The same of the missions in logs."""
    from lpac.paper.logged import REPORTS, LoggedMissions, ids_in
    from lpac.study.provenance import made_by

    folder = options.out or _OUT / name
    bundle = options.bundles[0] if options.bundles else None
    records = _missions(logs, options, bundle)
    words = ["paper", name, "--logs", str(logs)]
    words += [word for its in options.trial or () for word in ("--trial", its)]
    words += ["--world-file", str(options.world_file)] if options.world_file is not None else []
    words += ["--bundle", str(bundle)] if bundle is not None else []
    report = REPORTS[name](
        LoggedMissions(
            records=records, bundle=bundle or DEFAULT_BUNDLE, logs=logs, folder=folder,
            made_by=made_by(shlex.join(words), ids_in(records)), pool=pool(None), note=_note,
        )
    )  # fmt: skip
    told = report.write(folder)
    if options.as_json:
        typer.echo(json.dumps(told, indent=2))
    else:
        show_report(report, folder)


def _missions(
    logs: Path, options: ExperimentOptions, bundle: Path | None
) -> "dict[str, FlightRecord]":
    """The missions in the logs below a folder, by name. Raises ValueError if one has no cost."""
    from lpac.analysis.examination import Wanted, examine

    wanted = Wanted(
        missions=tuple(options.trial or ()), world=options.world_file, bundle=bundle,
        world_option="--world-file",
    )  # fmt: skip
    examined = examine([logs], wanted)
    if examined.without_cost:
        why = next(iter(examined.without_cost.values()))
        others = "; or choose other missions with --trial" if len(examined.records) > 1 else ""
        raise ValueError(f"{why}{others}")
    for note in examined.notes:
        _note(note)
    return {record.name: record for record in examined.records}


def _note(text: str) -> None:
    typer.echo(f"note: {text}", err=True)


@app.command()
def network(
    *,
    namespaces: _Namespaces = None,
    quick: _Quick = False,
    as_json: AsJson = False,
    out: _Out = None,
) -> None:
    """Table I, and throughput by number of robots: `lpac bench network` with what is installed."""
    from lpac.cli.bench import network as measure
    from lpac.middleware.kinds import MIDDLEWARES
    from lpac.paper.network import network_report
    from lpac.study.provenance import made_by

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
    told = json.loads((folder / "network.json").read_text())
    command = _network_command(namespaces, quick=quick)
    network_report(told, made_by(command, [])).write(folder)
    (folder / _MADE_FOR_ALL).unlink(missing_ok=True)


def _network_command(namespaces: str | None, *, quick: bool) -> str:
    chosen = [] if namespaces is None else [f"--namespaces {namespaces}"]
    return " ".join(["paper network", *chosen, *(["--quick"] if quick else [])])


@app.command("all")
def everything(
    *,
    bundle: Annotated[Path, typer.Option(help="Policy bundle.")] = DEFAULT_BUNDLE,
    quick: _Quick = False,
    namespaces: _Namespaces = None,
    ray: Ray = None,
    out: _Out = None,
) -> None:
    """All of them, and one page: each claim of the paper beside the result here.

    Whole robots fly e1, e2 and e3, or points with --quick. Results that were made with the same
    bundle and code are reused.
    """
    from edge.policy.bundle import load_bundle
    from lpac.cli.bench import require_namespaces
    from lpac.paper.repeated import write_page
    from lpac.study.provenance import made_by

    folder, loaded = out or _OUT, load_bundle(bundle)
    # Known before hours of flights.
    require_namespaces(namespaces, _QUICK_NETWORK[0] if quick else None)
    tasks = [_task_of_all(name, bundle, folder, quick=quick) for name in _IN_THE_AIR]
    told = {task.name: made_by(task.command, [loaded.id]) for task in tasks}
    told["network"] = made_by(_network_command(namespaces, quick=quick), [])
    missing = [task for task in tasks if not _is_made(task.folder, told[task.name])]
    reports = fly_together(missing, folder, ray) if missing else []
    for task, report in zip(missing, reports, strict=True):
        typer.echo(f"{task.name}\n")
        show_report(report, task.folder)
        typer.echo()
        _note_made(task.folder, told[task.name])
    if not _is_made(folder / "network", told["network"]):
        typer.echo("network\n")
        network(quick=quick, namespaces=namespaces, out=folder / "network")
        typer.echo()
        _note_made(folder / "network", told["network"])
    typer.echo(f"see {write_page(folder, loaded, told)}")


def _task_of_all(name: str, bundle: Path, folder: Path, *, quick: bool) -> StudyTask:
    of_few_flights = name in ("e1", "e2", "e3")
    whole = of_few_flights and not quick
    options = ExperimentOptions(
        bundles=[bundle], out=folder / name,
        vehicle=VehicleKind.SIMULATED if whole else VehicleKind.POINT,
    )  # fmt: skip
    return _task(name, options, {}, quick=quick and not of_few_flights)


def _is_made(folder: Path, made_by: Mapping[str, str]) -> bool:
    """Whether what is there was made so; else it is made again."""
    kept = folder / _MADE_FOR_ALL
    return kept.exists() and json.loads(kept.read_text()) == made_by


def _note_made(folder: Path, made_by: Mapping[str, str]) -> None:
    (folder / _MADE_FOR_ALL).write_text(json.dumps(made_by) + "\n")
