"""`lpac drill`: faults in flight, and the promises that must hold."""

import shlex
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from msgspec import Meta

from lpac.cli.apps import new_app
from lpac.cli.fields import options_of
from lpac.cli.options import (
    DEFAULT_BUNDLE,
    DEFAULT_SENSOR,
    AsJson,
    Px4,
    Ray,
    Sensor,
    VehicleKind,
    check_px4,
    folder_lock,
    pool,
    require_here,
)
from lpac.cli.printing import print_table
from lpac.cli.study import progress_counter, show_report

if TYPE_CHECKING:
    from lpac.study.drill_report import Outcomes
    from lpac.study.drills import Drill

app = new_app()

_OUT = Path("out/drill")


@dataclass(frozen=True, slots=True, kw_only=True)
class DrillOptions:
    """Options of `lpac drill`: flights, engine, output."""

    vehicle: Annotated[
        Literal["simulated", "mavlink", "px4"],
        "simulated: on one simulated clock, over all cores; mavlink: one process per robot in real "
        "time, a few flights at once; px4: with real PX4s, one after another. The last two fly "
        "only the faults that `--list` marks.",
    ] = "simulated"
    px4: Px4 = None
    faults: Annotated[
        list[str] | None,
        typer.Option("--fault", metavar="NAME", help="Only this fault; may be repeated."),
    ] = None
    seeds: Annotated[
        Annotated[int, Meta(ge=1)] | None,
        "Fly each fault with this many seeds, from 0 on; else 1.",
    ] = None
    seed: Annotated[
        Annotated[int, Meta(ge=0)] | None,
        "Fly exactly this seed; with a single --fault also its flight logs and a figure, all in "
        "FAULT-SEED in --out.",
    ] = None
    robots: Annotated[
        int, Meta(ge=2, le=10), typer.Option("--robots", "-n", help="Number of robots.")
    ] = 4
    bundle: Annotated[Path, "Policy bundle."] = DEFAULT_BUNDLE
    sensor: Sensor = DEFAULT_SENSOR
    ray: Ray = None
    listing: Annotated[bool, typer.Option("--list", help="Only list the faults.")] = False
    as_json: AsJson = False
    out: Annotated[
        Path | None,
        typer.Option(
            help=f"Folder for drill.json, drill.csv, README.md, drill.xml (JUnit) and flights; by "
            f"default {_OUT}, or {_OUT}-mavlink or {_OUT}-px4."
        ),
    ] = None


@app.command()
@options_of(DrillOptions)
def drill(options: DrillOptions) -> None:
    """Inject faults into a flying fleet, and check promises against the true tracks."""
    from lpac.study.drills import Drill, faults_of

    names, vehicle = tuple(options.faults or ()), options.vehicle
    if options.listing:
        _list(names)
        return
    if options.seeds is not None and options.seed is not None:
        raise ValueError("--seeds and --seed: give one of them")
    check_px4(VehicleKind(vehicle), options.px4)
    faults_of(names, vehicle, "--fault")
    flown = Drill(
        faults=names, seeds=options.seeds or 1, first_seed=options.seed or 0, robots=options.robots,
        engine=vehicle, bundle=str(options.bundle), sensor=options.sensor,
    )  # fmt: skip
    again = options.seed is not None and len(names) == 1
    fly_faults(flown, options.out, options.px4, options.ray, as_json=options.as_json, again=again)


def fly_faults(
    drill: "Drill",
    out: Path | None,
    px4: Path | None,
    ray: str | None,
    *,
    as_json: bool,
    again: bool = False,
) -> None:
    """Fly a drill, write its report and print it; with `again` one flight, which keeps its logs."""
    from lpac.study.drills import fly_drill, logs_of, outcomes_of

    require_here(VehicleKind(drill.engine), ray)
    folder, in_real_time = out or _OUT, drill.engine != "simulated"
    if in_real_time:
        folder = out or Path(f"{_OUT}-{drill.engine}")
        # SIGTERM must end the robots' programs as Ctrl-C does.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    flights, cores = drill.flights(px4), pool(ray)
    if again:
        outcomes = dict(outcomes_of((flights[0],), folder))
        # Beside its logs, since a campaign's report must not be overwritten.
        folder = logs_of(flights[0], folder)
    else:
        with folder_lock("the drill", folder), progress_counter("flights") as on_progress:
            outcomes = fly_drill(flights, folder, cores, on_progress)
    _report(outcomes, folder, as_json=as_json)
    if again or in_real_time:
        note = "logs and figures are there, too; `lpac report FOLDER` shows more of a mission"
        typer.echo(note, err=True)
    if not all(outcome.held for outcome in outcomes.values()):
        raise typer.Exit(1)


def _report(outcomes: "Outcomes", folder: Path, *, as_json: bool) -> None:
    """Write the report and JUnit's XML, and print the report."""
    from lpac.study.drill_report import as_junit, report_of
    from lpac.study.provenance import made_by

    bundle_id = next(iter(outcomes)).flown_by
    report = report_of(outcomes, made_by(shlex.join(sys.argv[1:]), [bundle_id]))
    report.write(folder)
    (folder / "drill.xml").write_bytes(as_junit(outcomes))
    show_report(report, folder, as_json=as_json)


def _list(names: Sequence[str]) -> None:
    from lpac.sim.engines import INJECTIONS, flies
    from lpac.study.drills import faults_of

    print_table(
        ("fault", "what happens", "promise", "flown by"),
        [
            (
                fault.name,
                fault.what,
                fault.promise + (f" (not covered: {fault.uncovered})" if fault.uncovered else ""),
                ", ".join(engine for engine in INJECTIONS if flies(engine, fault)),
            )
            for fault in faults_of(names, "simulated", "--fault")
        ],
    )
