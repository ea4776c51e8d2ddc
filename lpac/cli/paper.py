"""`lpac paper`: the paper's experiments, repeated."""

import json
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lpac.cli.apps import new_app
from lpac.cli.fields import chosen, options_of
from lpac.cli.options import (
    DEFAULT_BUNDLE,
    AsJson,
    Px4,
    Ray,
    VehicleKind,
    check_px4,
    existing,
    pool,
    require_here,
)
from lpac.cli.study import StudyTask, fly_study, fly_together, show_report

if TYPE_CHECKING:
    from lpac.analysis.flight import FlightRecord

app = new_app(
    "paper", "Repeat the paper's experiments, and run others that its arguments call for."
)

_OUT = Path("out/paper")
# Marks results of `lpac paper all`, which it reuses.
_MADE_FOR_ALL = "made_by.json"
_IN_THE_AIR = ("e1", "e2", "e3", "transfer", "async")
# Robots, repetitions, s.
_QUICK_NETWORK = (3, 1, 8.0)
_Out = Annotated[
    Path | None,
    typer.Option(help="Folder for figures, data and README.md; out/paper/NAME if none."),
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
    """Options of each experiment: what flies, or logs of a flight."""

    bundles: Annotated[
        list[Path] | None,
        typer.Option(
            "--bundle",
            help="Policy bundle, the shipped one if not given; with --logs the flown one, which "
            "defines the baselines' sensors and radio range. `transfer` takes several.",
        ),
    ] = None
    vehicle: Annotated[VehicleKind, "Points, or whole robots, as in `lpac sim`."] = (
        VehicleKind.POINT
    )
    px4: Px4 = None
    logs: Annotated[
        Path | None,
        typer.Option(
            callback=existing,
            help="Folder of flight logs, such as a field day's; nothing is flown.",
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Changes:
    """Changes of an experiment; options that are None change nothing."""

    worlds: Annotated[
        int | None,
        typer.Option(
            "--worlds", "-k",
            help="Number of worlds of the validation set, from the first on; else the study's, and "
            "a fifth of it, or one in real time, for whole robots in `async` and `transfer`.",
        ),
    ] = None  # fmt: skip
    trials: Annotated[int | None, "Number of trials; else 3."] = None
    world: Annotated[int | None, "Number of the world, of the validation set; else 0."] = None
    set_ups: Annotated[
        list[str] | None,
        typer.Option(
            "--set-up", metavar="NAME", help="Only this one (docs/research.md); may be repeated."
        ),
    ] = None
    quick: _Quick = False


def _add(name: str, about: str, *changes: str) -> Callable[..., None]:
    """Add an experiment's command, with these fields of `Changes` as options."""

    @options_of(ExperimentOptions, chosen(Changes, *changes))
    def command(options: ExperimentOptions, given: Any) -> None:
        changed = {each: getattr(given, each) for each in changes}
        _experiment(name, options, Changes(**changed))

    app.command(name, help=about)(command)
    return command


e1 = _add("e1", "Transferability: unseen worlds from the same starts, beside baselines.", "worlds")
e2 = _add(
    "e2", "Repeatability: trials in one world with small errors of starts and GPS.",
    "trials", "world",
)  # fmt: skip
e3 = _add("e3", "Perturbation: robots are removed at steady state, and brought back.", "world")
asynchrony = _add(
    "async", "The cost of slow and unsynchronised loops, and of late messages.", "worlds", "quick"
)
transfer = _add(
    "transfer", "Other numbers of robots, features and ranges: `lpac evaluate` in the paper's "
    "set-ups.", "worlds", "set_ups", "quick",
)  # fmt: skip


def _experiment(name: str, options: ExperimentOptions, changes: Changes) -> None:
    """Fly the experiment, or evaluate logs of it."""
    _check(name, options, changes)
    if options.logs is not None:
        _from_logs(name, options.logs, options)
        return
    task = _task(name, options, changes)
    fly_study(task, options.ray, as_json=options.as_json)
    (task.folder / _MADE_FOR_ALL).unlink(missing_ok=True)


def _task(name: str, options: ExperimentOptions, changes: Changes) -> StudyTask:
    """The experiment with its changes, and the command that repeats it."""
    from lpac.paper.experiments import experiment

    bundles, vehicle = options.bundles or [DEFAULT_BUNDLE], options.vehicle
    study = experiment(
        name, bundles, engine=vehicle.value, px4_build=options.px4, quick=changes.quick,
        set_ups=changes.set_ups or (),
    )  # fmt: skip
    numbers = {"worlds": changes.worlds, "trials": changes.trials, "first_world": changes.world}
    given: dict[str, Any] = {k: number for k, number in numbers.items() if number is not None}
    words = ["paper", name]
    words += [] if vehicle is VehicleKind.POINT else ["--vehicle", vehicle.value]
    for key, number in given.items():
        words += [f"--{key.removeprefix('first_')}", str(number)]
    words += [word for each in changes.set_ups or () for word in ("--set-up", each)]
    words += [
        word for path in bundles if path != DEFAULT_BUNDLE for word in ("--bundle", str(path))
    ]
    words += ["--quick"] if changes.quick else []
    return StudyTask(
        name=name, study=replace(study, **given), folder=options.out or _OUT / name,
        command=shlex.join(words),
    )  # fmt: skip


def _check(name: str, options: ExperimentOptions, changes: Changes) -> None:
    """Raise ValueError for an option without effect, or an impossible one."""
    if changes.trials is not None and changes.trials < 2:
        raise ValueError(f"--trials {changes.trials}: must be at least 2")
    for path in options.bundles or ():
        existing(path)
    if len(options.bundles or ()) > 1 and (name != "transfer" or options.logs is not None):
        raise ValueError("one bundle flew, so give --bundle once")
    if options.logs is not None:
        flying = {
            "--worlds": changes.worlds, "--trials": changes.trials, "--world": changes.world,
            "--set-up": changes.set_ups, "--quick": changes.quick or None, "--ray": options.ray,
            "--vehicle": None if options.vehicle is VehicleKind.POINT else options.vehicle,
            "--px4": options.px4,
        }  # fmt: skip
        for flag, value in flying.items():
            if value is not None:
                raise ValueError(f"{flag} does nothing with --logs")
        return
    check_px4(options.vehicle, options.px4)
    require_here(options.vehicle, options.ray)
    if options.trial or options.world_file is not None:
        option = "--trial" if options.trial else "--world-file"
        raise ValueError(f"{option} does nothing without --logs")


def _from_logs(name: str, logs: Path, options: ExperimentOptions) -> None:
    """Make an experiment's report from the missions in logs."""
    from lpac.paper.logged import REPORTS, LoggedMissions, ids_in
    from lpac.study.provenance import made_by

    folder = options.out or _OUT / name
    bundle = options.bundles[0] if options.bundles else None
    records = _missions(logs, options, bundle)
    words = ["paper", name, "--logs", str(logs)]
    words += [word for trial in options.trial or () for word in ("--trial", trial)]
    words += ["--world-file", str(options.world_file)] if options.world_file is not None else []
    words += ["--bundle", str(bundle)] if bundle is not None else []
    report = REPORTS[name](
        LoggedMissions(
            records=records, bundle=bundle or DEFAULT_BUNDLE, logs=logs, folder=folder,
            made_by=made_by(shlex.join(words), ids_in(records)), pool=pool(None), note=_note,
        )
    )  # fmt: skip
    report.write(folder)
    show_report(report, folder, as_json=options.as_json)


def _missions(
    logs: Path, options: ExperimentOptions, bundle: Path | None
) -> "dict[str, FlightRecord]":
    """Missions in the logs below a folder, by name. Raises ValueError if one has no cost."""
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
    """Table I, and throughput over robots: `lpac bench network` with all installed middlewares."""
    from lpac.cli.bench import network as measure
    from lpac.middleware.kinds import MIDDLEWARES
    from lpac.paper.network import network_report
    from lpac.study.provenance import made_by

    folder = out or _OUT / "network"
    robots, repetitions, seconds = _QUICK_NETWORK if quick else (None, None, None)
    measure(
        middlewares=[name for name, each in MIDDLEWARES.items() if each.version() is not None],
        robots=robots,
        repetitions=repetitions,
        seconds=seconds,
        namespaces=namespaces,
        as_json=as_json,
        out=folder,
    )
    measured = json.loads((folder / "network.json").read_text())
    command = _network_command(namespaces, quick=quick)
    network_report(measured, made_by(command, [])).write(folder)
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
    """Run all experiments, and write a page with each claim of the paper beside our result.

    Whole robots fly e1, e2 and e3, or points with --quick. Results of the same bundle and code are
    reused.
    """
    from edge.policy.bundle import load_bundle
    from lpac.cli.bench import require_namespaces
    from lpac.paper.repeated import write_page
    from lpac.study.provenance import made_by

    folder, loaded = out or _OUT, load_bundle(bundle)
    # Fail before hours of flights.
    require_namespaces(namespaces, _QUICK_NETWORK[0] if quick else None)
    tasks = [_task_of_all(name, bundle, folder, quick=quick) for name in _IN_THE_AIR]
    provenance = {task.name: made_by(task.command, [loaded.id]) for task in tasks}
    provenance["network"] = made_by(_network_command(namespaces, quick=quick), [])
    missing = [task for task in tasks if not _is_made(task.folder, provenance[task.name])]
    reports = fly_together(missing, folder, ray) if missing else []
    for task, report in zip(missing, reports, strict=True):
        typer.echo(f"{task.name}\n")
        show_report(report, task.folder)
        typer.echo()
        _note_made(task.folder, provenance[task.name])
    if not _is_made(folder / "network", provenance["network"]):
        typer.echo("network\n")
        network(quick=quick, namespaces=namespaces, out=folder / "network")
        typer.echo()
        _note_made(folder / "network", provenance["network"])
    typer.echo(f"see {write_page(folder, loaded, provenance)}")


def _task_of_all(name: str, bundle: Path, folder: Path, *, quick: bool) -> StudyTask:
    of_few_flights = name in ("e1", "e2", "e3")
    whole = of_few_flights and not quick
    options = ExperimentOptions(
        bundles=[bundle], out=folder / name,
        vehicle=VehicleKind.SIMULATED if whole else VehicleKind.POINT,
    )  # fmt: skip
    return _task(name, options, Changes(quick=quick and not of_few_flights))


def _is_made(folder: Path, made_by: Mapping[str, str]) -> bool:
    """Whether the folder has results of this provenance."""
    kept = folder / _MADE_FOR_ALL
    return kept.exists() and json.loads(kept.read_text()) == made_by


def _note_made(folder: Path, made_by: Mapping[str, str]) -> None:
    (folder / _MADE_FOR_ALL).write_text(json.dumps(made_by) + "\n")
