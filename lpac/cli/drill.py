"""`lpac drill`: faults in flight, and whether what is promised then holds."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import DEFAULT_BUNDLE
from lpac.cli.printing import BAD, GOOD, print_table, styled

if TYPE_CHECKING:
    from lpac.sim.drill.campaign import Campaign, FlightOutcome, Pool
    from lpac.sim.drill.faults import Fault

app = new_app()

_OUT = Path("out/drill")


@app.command()
def drill(
    *,
    faults: Annotated[
        list[str] | None,
        typer.Option("--fault", metavar="NAME", help="Only this fault; may be repeated."),
    ] = None,
    seeds: Annotated[int, typer.Option(help="Fly each fault with so many seeds, from 0 on.")] = 1,
    seed: Annotated[
        int | None,
        typer.Option(help="Fly exactly this one; of one fault with its flight logs and a figure."),
    ] = None,
    robots: Annotated[int, typer.Option("--robots", "-n", help="Number of robots.")] = 4,
    bundle: Annotated[Path, typer.Option(help="Policy bundle.")] = DEFAULT_BUNDLE,
    ray: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Fly on a Ray cluster, such as auto or HOST:6379."),
    ] = None,
    listing: Annotated[
        bool, typer.Option("--list", help="Only say which faults there are.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
    out: Annotated[
        Path, typer.Option(help="Folder for drill.json, drill.xml (JUnit), and what was flown.")
    ] = _OUT,
) -> None:
    """Do faults to a fleet in flight, and judge by the vehicles' truth what is promised."""
    from lpac.sim.drill.campaign import Campaign
    from lpac.sim.drill.report import as_json as to_json
    from lpac.sim.drill.report import as_junit

    chosen = _chosen(faults)
    if listing:
        _list(chosen)
        return
    if seeds < 1:
        raise ValueError(f"--seeds {seeds}: must be at least 1")
    if not 2 <= robots <= 10:
        raise ValueError(f"--robots {robots}: must be from 2 to 10")
    if seed is not None and len(chosen) == 1:
        outcomes = [_fly_again(chosen[0], seed, robots, bundle, out / f"{chosen[0].name}-{seed}")]
    else:
        campaign = Campaign(out, "simulated", robots, bundle)
        numbers = range(seeds) if seed is None else [seed]
        outcomes = _fly(campaign, chosen, list(numbers), _pool(ray))
        result = to_json(outcomes)
        (out / "drill.json").write_text(json.dumps(result, indent=2) + "\n")
        (out / "drill.xml").write_bytes(as_junit(outcomes))
    if as_json:
        typer.echo(json.dumps(to_json(outcomes), indent=2))
    else:
        _show(outcomes, robots)
    if not all(outcome.held for outcome in outcomes):
        raise typer.Exit(1)


def _chosen(names: list[str] | None) -> list["Fault"]:
    from lpac.sim.drill.faults import FAULTS

    for name in names or ():
        if name not in FAULTS:
            raise ValueError(f"--fault {name}: there is none; `lpac drill --list` has all")
    return [FAULTS[name] for name in names or FAULTS]


def _pool(ray: str | None) -> "Pool":
    if ray is None:
        from lpac.sim.drill.campaign import over_cores

        return over_cores
    try:
        from lpac.sim.drill.cluster import over_ray
    except ModuleNotFoundError:
        raise ValueError("--ray needs Ray: `pip install 'lpac-edge[ray]'`") from None
    return over_ray(ray)


def _fly(
    campaign: "Campaign", faults: list["Fault"], seeds: list[int], pool: "Pool"
) -> list["FlightOutcome"]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    outcomes = []
    with Progress(
        TextColumn("flights"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
        TextColumn("{task.description}"), console=Console(stderr=True), transient=True,
    ) as progress:  # fmt: skip
        task, broken = progress.add_task("", total=len(faults) * len(seeds)), 0
        for outcome in campaign.fly(faults, seeds, pool):
            outcomes.append(outcome)
            broken += not outcome.held
            progress.update(
                task, advance=1, description=f"{broken} broke a promise" if broken else ""
            )
    order = {(f.name, s): i for i, (f, s) in enumerate((f, s) for f in faults for s in seeds)}
    return sorted(outcomes, key=lambda outcome: order[outcome.fault, outcome.seed])


def _fly_again(
    fault: "Fault", seed: int, robots: int, bundle: Path, folder: Path
) -> "FlightOutcome":
    """The same flight once more, with the robots' logs and a figure."""
    from edge.core import log
    from lpac.sim.drill.campaign import outcome_of
    from lpac.sim.drill.figure import write_figure
    from lpac.sim.drill.simulated import SimulatedDrill
    from lpac.sim.drill.truth import FlightTruth

    log.listen(log.show_errors)
    folder.mkdir(parents=True, exist_ok=True)

    def flown() -> FlightTruth:
        truth = SimulatedDrill(robots, bundle).fly(fault, seed, logs=folder)
        write_figure(fault, truth, folder)
        return truth

    outcome = outcome_of(fault, seed, flown)
    typer.echo(f"see {folder / 'drill.png'}; `lpac report {folder}` has more", err=True)
    return outcome


def _show(outcomes: list["FlightOutcome"], robots: int) -> None:
    from lpac.sim.drill.faults import FAULTS
    from lpac.sim.drill.report import at_most_share, shown, summaries

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
        f"{len(broken)} of {len(outcomes)} flights broke a promise: at 95 % confidence at most "
        f"{share:.2g} % do, in this model"
    )
    for outcome in broken:
        what = outcome.error or "; ".join(map(shown, outcome.broken))
        typer.echo(f"{outcome.fault}, seed {outcome.seed}: {what}")
        typer.echo(f"    lpac drill --fault {outcome.fault} --seed {outcome.seed} -n {robots}")


def _list(faults: list["Fault"]) -> None:
    print_table(
        ("fault", "what happens", "promise"),
        [(fault.name, fault.what, fault.promise) for fault in faults],
    )
