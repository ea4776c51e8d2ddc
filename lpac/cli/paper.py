"""`lpac paper`: the paper's experiments, repeated."""

import json
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

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
from lpac.cli.study import fly_study, show_report

if TYPE_CHECKING:
    from edge.policy.bundle import Bundle as LoadedBundle
    from lpac.analysis.flight import FlightRecord
    from lpac.study.report import Report

app = new_app("paper", "Repeat the paper's experiments, and run some that its arguments call for.")

_OUT = Path("out/paper")
# By this `lpac paper all` knows what it made itself, and need not make again.
_MADE_FOR_ALL = "made_by.json"
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
    folder, bundles = options.out or _OUT / name, options.bundles or [DEFAULT_BUNDLE]
    if options.logs is not None:
        _from_logs(name, options.logs, options, folder)
        return
    from lpac.paper.experiments import experiment

    study = experiment(
        name, bundles, engine=options.vehicle.value, px4_build=options.px4, quick=quick,
        set_ups=given.pop("set_ups", ()),
    )  # fmt: skip
    study = replace(study, **given)
    made = [f"{_OPTIONS[key]} {value}" for key, value in given.items()]
    made += [f"--set-up {its}" for its in changes.get("set_ups") or ()]
    made += [f"--bundle {path}" for path in bundles if path != DEFAULT_BUNDLE]
    made += ["--quick"] if quick else []
    command = " ".join(["paper", name, *_vehicle(options.vehicle), *made])
    fly_study(study, name, folder, options.ray, as_json=options.as_json, command=command)
    (folder / _MADE_FOR_ALL).unlink(missing_ok=True)


def _vehicle(vehicle: VehicleKind) -> list[str]:
    return [] if vehicle is VehicleKind.POINT else [f"--vehicle {vehicle.value}"]


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


class Logged(NamedTuple):
    """Missions of logs by name, the bundle that flew, and where the report goes."""

    records: "dict[str, FlightRecord]"
    bundle: Path
    logs: Path
    folder: Path
    made_by: dict[str, str]


def _from_logs(name: str, logs: Path, options: ExperimentOptions, folder: Path) -> None:
    """The same of the missions in logs."""
    bundle = options.bundles[0] if options.bundles else None
    records = _logged(logs, options, bundle)
    made_by = _made_from_logs(name, logs, options, bundle, records)
    logged = Logged(records, bundle or DEFAULT_BUNDLE, logs, folder, made_by)
    report = _reports[name](logged)
    told = report.write(folder)
    if options.as_json:
        typer.echo(json.dumps(told, indent=2))
    else:
        show_report(report, folder)


def _logged(
    logs: Path, options: ExperimentOptions, bundle: Path | None
) -> "dict[str, FlightRecord]":
    """The missions in the logs below a folder, by name. Raises ValueError if one has no cost."""
    from lpac.analysis.examination import Wanted, examine

    wanted = Wanted(
        missions=tuple(options.trial or ()), world=options.world_file, bundle=bundle,
        world_option="--world-file",
    )  # fmt: skip
    examined = examine([logs], wanted)
    for record in examined.records:
        if not len(record.normalized):
            why = [note for note in examined.notes if note.startswith(f"{record.name}: ")]
            others = "; or choose other missions with --trial" if len(examined.records) > 1 else ""
            raise ValueError("; ".join(why or [f"{record.name}: no cost is known"]) + others)
    for note in examined.notes:
        typer.echo(f"note: {note}", err=True)
    return {record.name: record for record in examined.records}


def _e1_of_logs(of: Logged) -> "Report":
    """Each mission that the bundle flew beside the baselines."""
    from edge.policy.bundle import load_bundle
    from lpac.paper.logged import baselines_beside, e1_of_logs
    from lpac.study.flights import sizes_of
    from lpac.study.study import BASELINES

    bundle = load_bundle(of.bundle)
    others = [name for name, record in of.records.items() if _ids_in({name: record}) != [bundle.id]]
    if others:
        typer.echo(
            f"note: {of.bundle} is not what flew {', '.join(others)}, so what baselines would see "
            "there is not known: they are left out; give the bundle that flew with --bundle",
            err=True,
        )
    own = {name: record for name, record in of.records.items() if name not in others}
    beside = baselines_beside(own, of.bundle, sizes_of(bundle), BASELINES, pool(None))
    by_mission = {n: {"flight": record, **beside.get(n, {})} for n, record in of.records.items()}
    return e1_of_logs(by_mission, of.folder, of.made_by)


def _e2_of_logs(of: Logged) -> "Report":
    from lpac.paper.logged import e2_of_logs

    if len(of.records) < 2:
        raise ValueError(f"missions in {of.logs}: {len(of.records)}: must be at least 2")
    return e2_of_logs(of.records, of.folder, of.made_by)


def _e3_of_logs(of: Logged) -> "Report":
    from lpac.paper.logged import e3_of_logs
    from lpac.sim.description import FIELD_SCALE

    if len(of.records) > 1:
        raise ValueError(f"{of.logs}: has {', '.join(of.records)}: choose one mission with --trial")
    bundle = _that_flew(of.bundle, of.records, "which says how far robots hear each other")
    assert bundle.manifest.perception is not None
    range_m = bundle.manifest.perception.communication_range / FIELD_SCALE.env_scale
    [record] = of.records.values()
    return e3_of_logs(record, range_m, of.folder, of.made_by)


def _async_of_logs(of: Logged) -> "Report":
    """What the missions came to by their rates; says which are left out."""
    from lpac.paper.logged import async_of_logs
    from lpac.study.rates import LOGGED_S, is_comparable

    bundle = _that_flew(of.bundle, of.records, "which says how much robots say")
    for name, record in of.records.items():
        if not is_comparable(record):
            why = (
                "its robots' rates differ, or are not in their logs"
                if record.rates is None
                else f"it lasted {record.curve_time_s[-1]:.0f} s, less than {LOGGED_S:g}"
            )
            typer.echo(f"note: {name} is left out: {why}", err=True)
    return async_of_logs(of.records, bundle, of.folder, of.made_by)


def _transfer_of_logs(of: Logged) -> "Report":
    from lpac.paper.logged import transfer_of_logs

    bundle = _that_flew(of.bundle, of.records, "which says what baselines see")
    return transfer_of_logs(of.records, bundle, of.bundle, pool(None), of.folder, of.made_by)


_reports = {
    "e1": _e1_of_logs, "e2": _e2_of_logs, "e3": _e3_of_logs, "async": _async_of_logs,
    "transfer": _transfer_of_logs,
}  # fmt: skip


def _ids_in(records: "Mapping[str, FlightRecord]") -> list[str]:
    """The ids of the bundles that flew."""
    robots = [robot for record in records.values() for robot in record.robots]
    return sorted({said.bundle_id for robot in robots for said in robot.said})


def _that_flew(path: Path, records: "Mapping[str, FlightRecord]", why: str) -> "LoadedBundle":
    """Raises ValueError if another bundle flew, or it cannot fly."""
    from edge.policy.bundle import load_bundle

    bundle, flown = load_bundle(path), _ids_in(records)
    if bundle.manifest.perception is None:
        raise ValueError(f"{path}: has no perception: it cannot fly")
    if len(flown) > 1:
        raise ValueError(
            f"{' and '.join(its[:16] for its in flown)} flew: choose missions of one bundle with "
            "--trial"
        )
    if bundle.id not in flown:
        raise ValueError(
            f"{path}: is not what flew, {flown[0][:16]}: give that with --bundle, {why}"
        )
    return bundle


def _made_from_logs(
    name: str,
    logs: Path,
    options: ExperimentOptions,
    bundle: Path | None,
    records: "Mapping[str, FlightRecord]",
) -> dict[str, str]:
    from lpac.study.provenance import made_by

    given = [
        ("--logs", str(logs)),
        *(("--trial", its) for its in options.trial or ()),
        *(("--world-file", str(its)) for its in [options.world_file] if its is not None),
        *(("--bundle", str(its)) for its in [bundle] if its is not None),
    ]
    said = (f"{option} {shlex.quote(value)}" for option, value in given)
    return made_by(" ".join(["paper", name, *said]), _ids_in(records))


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
    command = " ".join(["paper network", *_for_network(namespaces, quick=quick)])
    told = json.loads((folder / "network.json").read_text())
    network_report(told, made_by(command, [])).write(folder)
    (folder / _MADE_FOR_ALL).unlink(missing_ok=True)


def _for_network(namespaces: str | None, *, quick: bool) -> list[str]:
    chosen = [] if namespaces is None else [f"--namespaces {namespaces}"]
    return [*chosen, *(["--quick"] if quick else [])]


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
    told = {}
    for name in ("e1", "e2", "e3", "transfer", "async"):
        flown = ExperimentOptions(bundles=[bundle], ray=ray, out=folder / name)
        small = quick and name in ("transfer", "async")
        if not quick and name in ("e1", "e2", "e3"):
            flown = replace(flown, vehicle=VehicleKind.SIMULATED)
        command = ["paper", name, *_vehicle(flown.vehicle), *(["--quick"] if small else [])]
        told[name] = made_by(" ".join(command), [loaded.id])
        fly = partial(_experiment, name, flown, {}, quick=small)
        _unless_made(name, folder / name, told[name], fly)
    command = ["paper network", *_for_network(namespaces, quick=quick)]
    told["network"] = made_by(" ".join(command), [])
    measure = partial(network, quick=quick, namespaces=namespaces, out=folder / "network")
    _unless_made("network", folder / "network", told["network"], measure)
    typer.echo(f"see {write_page(folder, loaded, told)}")


def _unless_made(
    name: str, folder: Path, made_by: dict[str, str], make: Callable[[], None]
) -> None:
    """Results are made again only if they were made otherwise."""
    kept = folder / _MADE_FOR_ALL
    if kept.exists() and json.loads(kept.read_text()) == made_by:
        return
    typer.echo(f"{name}\n")
    make()
    typer.echo()
    kept.write_text(json.dumps(made_by) + "\n")
