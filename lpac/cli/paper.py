"""`lpac paper`: the paper's experiments, repeated."""

import json
import platform
from contextlib import closing
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import DEFAULT_BUNDLE, AsJson, Ray, folder_lock, pool
from lpac.cli.printing import print_table, progress_of
from lpac.cli.sim import VehicleKind

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from lpac.analysis.flight import FlightRecord
    from lpac.paper.asynchrony import TimingResult
    from lpac.sim.experiment import Scenario, SimulatedFlight
    from lpac.sim.fleet.layout import FleetScenario

app = new_app()

_OUT = Path("out/paper")
_WORLDS, _QUICK_WORLDS = 50, 4
# Enough to see whether slower or faster is better.
_QUICK_HZ = {"perception_hz": (1.0, 5.0), "policy_hz": (0.5, 2.5, 10.0)}
_QUICK_DELAYS_S = (0.0, 0.8)
_QUICK_SET_UPS = ("field", "n3", "n32", "features-20", "range-128")
_VEHICLES = {
    VehicleKind.SIMULATED: "simulated PX4s on one simulated clock",
    VehicleKind.MAVLINK: "simulated PX4s, a program for each robot, in real time",
    VehicleKind.PX4: "real PX4s that run as software, a program for each robot",
}
# They take hours.
_TOO_LARGE = ("n300", "n1000")
# Robots, repetitions, s.
_QUICK_NETWORK = (3, 1, 8.0)


@app.callback()
def paper() -> None:
    """Repeat the paper's experiments, and make those that it argues for."""


Bundle = Annotated[Path, typer.Option(help="Policy bundle.")]
Vehicle = Annotated[
    VehicleKind, typer.Option(help="Points, or whole robots, as `lpac sim` has them.")
]
Px4 = Annotated[Path | None, typer.Option(help="px4: PX4's build folder.")]
Logs = Annotated[
    Path | None, typer.Option(help="Fly nothing: folder of logs of flights, as of a field day.")
]
Quick = Annotated[bool, typer.Option("--quick", help="Little of it, in a few minutes.")]
Out = Annotated[
    Path | None,
    typer.Option(help="Folder for figures, data and README.md; out/paper/NAME if none."),
]


@app.command()
def e1(
    *,
    bundle: Bundle = DEFAULT_BUNDLE,
    worlds: Annotated[int, typer.Option("--worlds", "-k", help="Of the validation set.")] = 3,
    vehicle: Vehicle = VehicleKind.POINT,
    px4: Px4 = None,
    logs: Logs = None,
    ray: Ray = None,
    as_json: AsJson = False,
    out: Out = None,
) -> None:
    """Transferability: unseen worlds from the same starts, beside baselines."""
    from lpac.paper.experiments import pads_of, transferability, whole_transferability
    from lpac.paper.report import write_transferability

    _at_least(1, worlds, "--worlds")
    folder = _folder(out, "e1")
    records: dict[str, dict[str, FlightRecord]]
    if logs is not None:
        records = {trial.name: {"flight": trial} for trial in _logged(logs)}
    else:
        whole = {}
        if vehicle is not VehicleKind.POINT:
            plan = whole_transferability(bundle, worlds)
            whole = _fly_whole(plan, bundle, vehicle, px4, ray, folder)
        points = transferability(worlds, pads_of(bundle) if whole else None)
        named = {(w, name): one for w, of_world in points.items() for name, one in of_world.items()}
        flown = dict(zip(named, _fly(list(named.values()), bundle, ray), strict=True))
        records = {world: {"whole robots": record} for world, record in whole.items()}
        for (world, name), flight in flown.items():
            records.setdefault(world, {})[name] = flight.record
    made_by = _made_by(f"e1 -k {worlds}{_flown_with(vehicle, logs)}", bundle)
    told = write_transferability(records, folder, made_by, _how(vehicle, logs))
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
    bundle: Bundle = DEFAULT_BUNDLE,
    trials: Annotated[int, typer.Option(help="How often.")] = 3,
    world: Annotated[int, typer.Option(help="Number of the world, of the validation set.")] = 0,
    vehicle: Vehicle = VehicleKind.POINT,
    px4: Px4 = None,
    logs: Logs = None,
    ray: Ray = None,
    as_json: AsJson = False,
    out: Out = None,
) -> None:
    """Repeatability: one world again and again, starts and GPS a little off."""
    from lpac.paper.experiments import repeatability, whole_repeatability
    from lpac.paper.report import write_repeatability

    _at_least(2, trials, "--trials")
    folder = _folder(out, "e2")
    if logs is not None:
        records = {trial.name: trial for trial in _logged(logs)}
        _at_least(2, len(records), f"missions in {logs}:")
    elif vehicle is VehicleKind.POINT:
        plan = repeatability(trials, world)
        flown = _fly(list(plan.values()), bundle, ray)
        records = {name: flight.record for name, flight in zip(plan, flown, strict=True)}
    else:
        whole = whole_repeatability(bundle, trials, world)
        records = _fly_whole(whole, bundle, vehicle, px4, ray, folder)
    made_by = _made_by(f"e2 --trials {trials} --world {world}{_flown_with(vehicle, logs)}", bundle)
    told = write_repeatability(records, folder, made_by, _how(vehicle, logs))
    spread = told["spread"]
    _tell(
        told, folder, as_json=as_json,
        lines=[
            *(f"{name}: {record.normalized[-1]:.3f}" for name, record in records.items()),
            f"mean {spread['final_mean']:.3f}, standard deviation {spread['final_deviation']:.3f}",
        ],
    )  # fmt: skip


def _logged(folder: Path) -> "Sequence[FlightRecord]":
    """The missions in the logs below a folder."""
    from lpac.analysis.report import Wanted, examine

    return examine([folder], Wanted(), lambda *_: None).trials


def _fly_whole(
    plan: "Mapping[str, FleetScenario]",
    bundle: Path,
    vehicle: VehicleKind,
    px4: Path | None,
    ray: str | None,
    folder: Path,
) -> "dict[str, FlightRecord]":
    """Whole robots; in real time one flight after another, whose logs stay in `folder`."""
    from lpac.paper import flown

    records: dict[str, FlightRecord] = {}
    with progress_of("flights") as progress:
        task = progress.add_task("", total=len(plan))
        if vehicle is VehicleKind.SIMULATED:
            scenarios = list(plan.values())
            with closing(flown.fly_whole(scenarios, bundle.resolve(), pool(ray))) as told:
                by_number = {}
                for number, record in told:
                    by_number[number] = record
                    progress.update(task, advance=1)
            return {name: by_number[number] for number, name in enumerate(plan)}
        _check_px4(vehicle, px4)
        for name, scenario in plan.items():
            its = folder / name.replace(" ", "-")
            records[name] = flown.fly_programs(scenario, its, bundle, px4)
            progress.update(task, advance=1)
    return records


def _check_px4(vehicle: VehicleKind, px4: Path | None) -> None:
    if (vehicle is VehicleKind.PX4) != (px4 is not None):
        raise ValueError("--px4 names PX4's build folder, and belongs to --vehicle px4")


def _flown_with(vehicle: VehicleKind, logs: Path | None) -> str:
    if logs is not None:
        return f" --logs {logs}"
    return "" if vehicle is VehicleKind.POINT else f" --vehicle {vehicle.value}"


def _how(vehicle: VehicleKind, logs: Path | None) -> str:
    from lpac.paper.report import LOGS, POINTS, WHOLE

    if logs is not None:
        return LOGS
    if vehicle is VehicleKind.POINT:
        return POINTS
    return WHOLE.format(vehicles=_VEHICLES[vehicle])


@app.command()
def e3(
    *,
    bundle: Bundle = DEFAULT_BUNDLE,
    world: Annotated[int, typer.Option(help="Number of the world, of the validation set.")] = 0,
    vehicle: Annotated[
        VehicleKind, typer.Option(help="point; or whole robots, of which a pilot takes some.")
    ] = VehicleKind.POINT,
    px4: Px4 = None,
    logs: Logs = None,
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
    from lpac.paper.flown import fly_piloted, fly_programs
    from lpac.paper.report import TAKEN_LOGS, TAKEN_POINTS, TAKEN_WHOLE, write_perturbation

    folder = _folder(out, "e3")
    if logs is not None:
        trials = _logged(logs)
        if len(trials) > 1:
            raise ValueError(f"{logs}: has {len(trials)} missions: give the folder of one")
        what, how = perturbed_by(trials[0], absences_of(trials[0]), _range_m(bundle)), TAKEN_LOGS
    elif vehicle is VehicleKind.POINT:
        [flight] = _fly([perturbation(world)], bundle, ray)
        what, how = perturbed(flight), TAKEN_POINTS
    else:
        scenario, pilots = whole_perturbation(bundle, world)
        with progress_of("flights") as progress:
            task = progress.add_task("", total=1)
            if vehicle is VehicleKind.SIMULATED:
                record = fly_piloted(scenario, bundle, pilots)
            else:
                _check_px4(vehicle, px4)
                record = fly_programs(scenario, folder / "flight", bundle, px4, pilots)
            progress.update(task, advance=1)
        what = perturbed_by(record, absences_of(record), _range_m(bundle))
        how = TAKEN_WHOLE.format(vehicles=_VEHICLES[vehicle])
    made_by = _made_by(f"e3 --world {world}{_flown_with(vehicle, logs)}", bundle)
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


def _range_m(bundle: Path) -> float:
    """How far the bundle's robots hear each other in the field's scale."""
    from edge.policy.bundle import load_bundle
    from lpac.sim.experiment import FIELD_SCALE

    perception = load_bundle(bundle).manifest.perception
    if perception is None:
        raise ValueError(f"{bundle}: has no perception: it cannot fly")
    return perception.communication_range / FIELD_SCALE.env_scale


def _at_least(least: int, value: int, option: str) -> None:
    if value < least:
        raise ValueError(f"{option} {value}: must be at least {least}")


def _folder(out: Path | None, name: str) -> Path:
    folder = out or _OUT / name
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _made_by(command: str, bundle: Path | None) -> dict[str, str]:
    import edge
    import lpac
    from edge.policy.bundle import load_bundle
    from lpac.sim.kept import code_digest

    policy = {"bundle": load_bundle(bundle).id} if bundle else {}
    return {
        "command": f"lpac paper {command}{f' --bundle {bundle}' if bundle else ''}",
        **policy,
        "lpac-edge": f"{version('lpac-edge')}, code {code_digest(edge, lpac)[:12]}",
        "python": platform.python_version(),
    }


def _fly(scenarios: "Sequence[Scenario]", bundle: Path, ray: str | None) -> "list[SimulatedFlight]":
    """All of them, in their order."""
    from edge.policy.bundle import load_bundle
    from lpac.paper.flown import fly_all

    load_bundle(bundle)
    flown: dict[int, SimulatedFlight] = {}
    with (
        progress_of("flights") as progress,
        closing(fly_all(scenarios, bundle.resolve(), pool(ray))) as told,
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
    bundle: Bundle = DEFAULT_BUNDLE,
    worlds: Annotated[
        int | None,
        typer.Option(
            "--worlds",
            "-k",
            help=f"The first so many of the validation set; {_WORLDS} if not "
            f"given, {_QUICK_WORLDS} with --quick.",
        ),
    ] = None,
    quick: Quick = False,
    ray: Ray = None,
    as_json: AsJson = False,
    out: Out = None,
) -> None:
    """Rates of perception and of messages, in step or not, and late messages: what they cost."""
    from edge.policy.bundle import load_bundle
    from lpac.evaluate.evaluation import TrainedBundle
    from lpac.evaluate.flights import KeptFlights
    from lpac.paper.asynchrony import AsynchronyPlan, results_of
    from lpac.paper.asynchrony import as_json as to_json
    from lpac.paper.asynchrony_report import write_report

    count = worlds if worlds is not None else _QUICK_WORLDS if quick else _WORLDS
    plan = AsynchronyPlan(
        bundle=TrainedBundle(str(bundle.resolve()), load_bundle(bundle).id),
        world_set="validation",
        worlds=count,
        **({**_QUICK_HZ, "delays_s": _QUICK_DELAYS_S} if quick else {}),
    )
    folder = out or _OUT / "async"
    with folder_lock("the experiment", folder):
        flights, flown = plan.flights(), {}
        with (
            progress_of("flights") as progress,
            closing(KeptFlights(folder).fly(flights, pool(ray))) as told,
        ):
            task = progress.add_task("", total=len(flights))
            for flight, cost in told:
                flown[flight] = cost
                progress.update(task, advance=1)
        results = results_of(plan, flown)
        made_by = _made_by(f"async -k {count}{' --quick' if quick else ''}", bundle)
        write_report(plan, results, folder, made_by)
    if as_json:
        typer.echo(json.dumps(to_json(plan, results), indent=2))
        return
    _show(results)
    typer.echo(f"\nsee {folder}: README.md, rates.png, staleness.png, async.csv, async.json")


@app.command()
def transfer(
    *,
    bundles: Annotated[
        list[Path] | None,
        typer.Option("--bundle", help="Policy bundle; may be repeated. The shipped one if none."),
    ] = None,
    worlds: Annotated[
        int | None,
        typer.Option("--worlds", "-k", help="Of the validation set: 20, or 2 with --quick."),
    ] = None,
    quick: Quick = False,
    ray: Ray = None,
    as_json: AsJson = False,
    out: Out = None,
) -> None:
    """Other numbers of robots, features and ranges: `lpac evaluate` in the paper's set-ups."""
    from lpac.cli.evaluate import evaluate
    from lpac.evaluate.worlds import SET_UPS

    large = [name for name in SET_UPS if name not in _TOO_LARGE]
    evaluate(
        methods=[str(bundle) for bundle in bundles or [DEFAULT_BUNDLE]],
        set_ups=[*_QUICK_SET_UPS] if quick else large,
        worlds=worlds if worlds is not None else 2 if quick else 20,
        baselines=["clairvoyant-cvt"],
        ray=ray,
        as_json=as_json,
        out=_folder(out, "transfer"),
    )


@app.command()
def network(
    *,
    namespaces: Annotated[
        str | None,
        typer.Option(metavar="NAME,NAME...", help="As `lpac bench network` has them."),
    ] = None,
    quick: Quick = False,
    as_json: AsJson = False,
    out: Out = None,
) -> None:
    """Table I, and throughput over the number of robots: `lpac bench network`, as installed."""
    from lpac.cli.bench import network as measure
    from lpac.network.middleware import MIDDLEWARES

    robots, repetitions, seconds = _QUICK_NETWORK if quick else (None, None, None)
    measure(
        middlewares=[name for name, its in MIDDLEWARES.items() if its.version() is not None],
        robots=robots,
        repetitions=repetitions,
        seconds=seconds,
        namespaces=namespaces,
        as_json=as_json,
        out=_folder(out, "network"),
    )


@app.command("all")
def everything(
    *,
    bundle: Bundle = DEFAULT_BUNDLE,
    quick: Quick = False,
    ray: Ray = None,
    out: Out = None,
) -> None:
    """All of them, and one page: each claim of the paper beside what came of it here.

    What was made with the same bundle and code is not made again.
    """
    from edge.policy.bundle import load_bundle
    from lpac.paper.repeated import write_page

    folder = out or _OUT
    loaded = load_bundle(bundle)
    flying: dict[str, Callable[[Path], None]] = {
        "e1": lambda its: e1(bundle=bundle, ray=ray, out=its),
        "e2": lambda its: e2(bundle=bundle, ray=ray, out=its),
        "e3": lambda its: e3(bundle=bundle, ray=ray, out=its),
        "transfer": lambda its: transfer(bundles=[bundle], quick=quick, ray=ray, out=its),
        "async": lambda its: asynchrony(bundle=bundle, quick=quick, ray=ray, out=its),
        "network": lambda its: network(quick=quick, out=its),
    }
    made_by = {}
    for name, make in flying.items():
        its = folder / name
        # A quick one of some is the only one that there is.
        option = " --quick" if quick and name not in ("e1", "e2", "e3") else ""
        made_by[name] = _made_by(f"{name}{option}", None if name == "network" else bundle)
        kept = its / "made_by.json"
        if kept.exists() and json.loads(kept.read_text()) == made_by[name]:
            continue
        typer.echo(f"{name}\n")
        make(its)
        typer.echo()
        kept.write_text(json.dumps(made_by[name]) + "\n")
    typer.echo(f"see {write_page(folder, loaded, made_by)}")


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
