"""`lpac drill`: faults in flight, and whether what is promised then holds."""

import json
import signal
from contextlib import closing
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import DEFAULT_BUNDLE, DEFAULT_SENSOR, Ray, Sensor, pool
from lpac.cli.printing import BAD, GOOD, print_table, progress_of, styled

if TYPE_CHECKING:
    from lpac.sim.drill.campaign import Campaign, FlightOutcome, Flown
    from lpac.sim.drill.faults import Fault
    from lpac.sim.drill.field import DrilledRobots
    from lpac.sim.drill.real_time import RealTimeDrill

app = new_app()

_OUT = Path("out/drill")


class DrillVehicle(StrEnum):
    """What the robots of a drill fly."""

    SIMULATED = "simulated"
    MAVLINK = "mavlink"
    PX4 = "px4"


@app.command()
def drill(
    *,
    vehicle: Annotated[
        DrillVehicle,
        typer.Option(
            help="simulated: on one simulated clock, over all cores; mavlink: one process per "
            "robot in real time, a few flights at once; px4: with real PX4s, one after another. "
            "The last two fly only the faults that `--list` marks."
        ),
    ] = DrillVehicle.SIMULATED,
    px4: Annotated[
        Path | None, typer.Option(help="px4: PX4's build folder, made by `make px4_sitl`.")
    ] = None,
    faults: Annotated[
        list[str] | None,
        typer.Option("--fault", metavar="NAME", help="Only this fault; may be repeated."),
    ] = None,
    seeds: Annotated[
        int | None, typer.Option(help="Fly each fault with this many seeds, from 0 on; else 1.")
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            help="Fly exactly this seed; with a single --fault also its flight logs and a figure, "
            "all in FAULT-SEED in --out."
        ),
    ] = None,
    robots: Annotated[int, typer.Option("--robots", "-n", help="Number of robots.")] = 4,
    bundle: Annotated[Path, typer.Option(help="Policy bundle.")] = DEFAULT_BUNDLE,
    sensor: Sensor = DEFAULT_SENSOR,
    ray: Ray = None,
    listing: Annotated[
        bool, typer.Option("--list", help="Only say which faults there are.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            help=f"Folder for drill.json, drill.xml (JUnit), and what was flown; by default "
            f"{_OUT}, or {_OUT}-mavlink or {_OUT}-px4."
        ),
    ] = None,
) -> None:
    """Inject faults into a fleet in flight, and judge by the truth whether promises held."""
    from lpac.sim.drill.campaign import Campaign, fly_order
    from lpac.sim.drill.field import DrilledRobots
    from lpac.sim.drill.summary import as_json as to_json
    from lpac.sim.drill.summary import as_junit

    chosen = _chosen(faults)
    if listing:
        _list(chosen)
        return
    numbers = _numbers(seeds, seed)
    if not 2 <= robots <= 10:
        raise ValueError(f"--robots {robots}: must be from 2 to 10")
    chosen = _flown(chosen, vehicle, by_name=bool(faults))
    if out is None:
        out = _OUT if vehicle is DrillVehicle.SIMULATED else Path(f"{_OUT}-{vehicle}")
    _require_sensor(sensor, bundle)
    drilled = DrilledRobots(robots, str(bundle.resolve()), sensor)
    real_time = _real_time(vehicle, px4, ray, out, drilled)
    options = _options(vehicle, px4, robots, bundle, sensor)
    if seed is not None and len(chosen) == 1 and real_time is None:
        outcomes = [_fly_again(chosen[0], seed, drilled, out / f"{chosen[0].name}-{seed}")]
    elif seed is not None and len(chosen) == 1 and real_time is not None:
        outcomes = [real_time.outcome(chosen[0], seed)]
    else:
        campaign = Campaign(out, vehicle, drilled, px4)
        flown = partial(pool(ray), fly_order) if real_time is None else real_time.fly_all
        outcomes = _fly(campaign, chosen, numbers, flown)
    if seed is not None and len(chosen) == 1:
        # Beside what it leaves, and not in place of a campaign's.
        out = out / f"{chosen[0].name}-{seed}"
    result = to_json(outcomes, options)
    (out / "drill.json").write_text(json.dumps(result, indent=2) + "\n")
    (out / "drill.xml").write_bytes(as_junit(outcomes, options))
    if as_json:
        typer.echo(json.dumps(result, indent=2))
    else:
        _show(outcomes, options)
        if real_time is not None:
            late_s = max(outcome.late_s for outcome in outcomes)
            typer.echo(
                f"this machine was at most {late_s:.1f} s behind real time in a flight; "
                f"logs and figures are in {out}"
            )
    if not all(outcome.held for outcome in outcomes):
        raise typer.Exit(1)


def _require_sensor(type_: str, bundle: Path) -> None:
    """Raises ConfigError before anything is flown."""
    from edge.drivers.registry import open_sensor
    from edge.policy.bundle import BundleError, load_bundle

    manifest = load_bundle(bundle).manifest
    if manifest.perception is None:
        raise BundleError(f"{bundle}: the bundle has no perception: it cannot fly")
    open_sensor(type_, {}, manifest)


def _numbers(seeds: int | None, seed: int | None) -> list[int]:
    """The seeds to fly."""
    if seeds is not None and seed is not None:
        raise ValueError("--seeds and --seed: give one of them")
    if seeds is not None and seeds < 1:
        raise ValueError(f"--seeds {seeds}: must be at least 1")
    if seed is not None and seed < 0:
        raise ValueError(f"--seed {seed}: must be at least 0")
    return list(range(seeds or 1)) if seed is None else [seed]


def _chosen(names: list[str] | None) -> list["Fault"]:
    from lpac.sim.drill.faults import FAULTS

    for name in names or ():
        if name not in FAULTS:
            raise ValueError(f"--fault {name}: there is none; `lpac drill --list` has all")
    return [FAULTS[name] for name in names or FAULTS]


def _flies(vehicle: DrillVehicle, fault: "Fault") -> bool:
    """Whether all that a fault does can be done to these vehicles."""
    from lpac.sim.drill.field import supports
    from lpac.sim.drill.processes import MAVLINK, PX4
    from lpac.sim.drill.simulated import SUPPORTED

    injections = {
        DrillVehicle.SIMULATED: SUPPORTED, DrillVehicle.MAVLINK: MAVLINK, DrillVehicle.PX4: PX4,
    }  # fmt: skip
    return supports(injections[vehicle], fault)


def _flown(faults: list["Fault"], vehicle: DrillVehicle, *, by_name: bool) -> list["Fault"]:
    """Those that the vehicles fly; who names others is told."""
    flown = [fault for fault in faults if _flies(vehicle, fault)]
    if by_name and len(flown) < len(faults):
        others = ", ".join(fault.name for fault in faults if fault not in flown)
        raise ValueError(
            f"--fault {others}: is not flown with --vehicle {vehicle}; `lpac drill --list` tells "
            "what is"
        )
    return flown


def _real_time(
    vehicle: DrillVehicle,
    px4: Path | None,
    ray: str | None,
    out: Path,
    drilled: "DrilledRobots",
) -> "RealTimeDrill | None":
    """None on the simulated clock."""
    if px4 is not None and vehicle is not DrillVehicle.PX4:
        raise ValueError(f"--px4 does nothing with --vehicle {vehicle}")
    if px4 is None and vehicle is DrillVehicle.PX4:
        raise ValueError("--vehicle px4 needs --px4 with PX4's build folder")
    if vehicle is DrillVehicle.SIMULATED:
        return None
    if ray is not None:
        raise ValueError(f"--ray does nothing with --vehicle {vehicle}")
    from edge.core.logger import show
    from lpac.sim.drill.real_time import RealTimeDrill

    show("error")
    # Whoever ends this command ends its programs, too.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    return RealTimeDrill(out, drilled, px4)


def _options(
    vehicle: DrillVehicle, px4: Path | None, robots: int, bundle: Path, sensor: str
) -> str:
    """Those with which the same is flown again."""
    options = f"-n {robots}"
    if bundle != DEFAULT_BUNDLE:
        options += f" --bundle {bundle}"
    if sensor != DEFAULT_SENSOR:
        options += f" --sensor {sensor}"
    if vehicle is not DrillVehicle.SIMULATED:
        options += f" --vehicle {vehicle}"
    return options if px4 is None else f"{options} --px4 {px4}"


def _fly(
    campaign: "Campaign", faults: list["Fault"], seeds: list[int], flown: "Flown"
) -> list["FlightOutcome"]:
    outcomes = []
    with (
        progress_of("flights") as progress,
        closing(campaign.fly(faults, seeds, flown)) as flights,
    ):
        task, broken = progress.add_task("", total=len(faults) * len(seeds)), 0
        for outcome in flights:
            outcomes.append(outcome)
            broken += not outcome.held
            progress.update(
                task, advance=1, description=f"{broken} broke a promise" if broken else ""
            )
    order = {(f.name, s): i for i, (f, s) in enumerate((f, s) for f in faults for s in seeds)}
    return sorted(outcomes, key=lambda outcome: order[outcome.fault, outcome.seed])


def _fly_again(
    fault: "Fault", seed: int, drilled: "DrilledRobots", folder: Path
) -> "FlightOutcome":
    """The same flight once more, with the robots' logs and a figure."""
    from edge.core.logger import show
    from lpac.analysis.truth import TRUTH, write_truth
    from lpac.sim.drill.campaign import outcome_of
    from lpac.sim.drill.figure import write_figure
    from lpac.sim.drill.simulated import SimulatedDrill
    from lpac.sim.drill.truth import FlightTruth, tracks_of

    show("error")
    folder.mkdir(parents=True, exist_ok=True)

    def flown() -> FlightTruth:
        truth = SimulatedDrill(drilled).fly(fault, seed, logs=folder)
        write_figure(fault, truth, folder)
        write_truth(tracks_of(truth), folder / TRUTH)
        return truth

    outcome = outcome_of(fault, seed, flown)
    typer.echo(
        f"see {folder / 'drill.png'}; if a mission was flown, `lpac report {folder}` has more",
        err=True,
    )
    return outcome


def _show(outcomes: list["FlightOutcome"], options: str) -> None:
    from edge.core.counted import counted
    from lpac.analysis.statistics import at_most_share
    from lpac.sim.drill.faults import FAULTS
    from lpac.sim.drill.summary import flown_again_by, shown, summaries

    rows = []
    for summary in summaries(outcomes):
        kept = summary.flights - summary.broken
        tightest = summary.tightest
        rows.append(
            (
                summary.fault,
                FAULTS[summary.fault].promise,
                styled(f"{kept} of {summary.flights}", BAD if summary.broken else GOOD),
                "" if tightest is None else shown(tightest),
            )
        )
    print_table(("fault", "promise", "kept", "nearest its limit"), rows)
    broken = [outcome for outcome in outcomes if not outcome.held]
    share = 100.0 * at_most_share(len(outcomes), len(broken))
    typer.echo(
        f"{len(broken)} of {counted(len(outcomes), 'flight')} broke a promise: at 95 % confidence "
        f"at most {share:.3g} % do, in this model"
    )
    for outcome in broken:
        what = outcome.error or "; ".join(map(shown, outcome.broken))
        typer.echo(f"{outcome.fault}, seed {outcome.seed}: {what}")
        typer.echo(f"    {flown_again_by(outcome, options)}")


def _list(faults: list["Fault"]) -> None:
    print_table(
        ("fault", "what happens", "promise", "flown by"),
        [
            (
                fault.name,
                fault.what,
                fault.promise + (f" (not covered: {fault.uncovered})" if fault.uncovered else ""),
                ", ".join(vehicle for vehicle in DrillVehicle if _flies(vehicle, fault)),
            )
            for fault in faults
        ],
    )
