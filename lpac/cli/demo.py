"""`lpac demo`: the policy beside the baselines."""

from pathlib import Path
from typing import Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import DEFAULT_BUNDLE
from lpac.cli.sim import fly_showing

app = new_app()


@app.command()
def demo(
    *,
    out: Annotated[Path, typer.Option(help="Folder for the figure and the flights.")] = Path(
        "out/demo"
    ),
    seed: Annotated[int, typer.Option(help="Seed of world, starts, clocks and losses.")] = 7,
) -> None:
    """Fly ten robots and the baselines over an unknown world for 60 s, and draw a figure."""
    from lpac.sim.flight_files import write_demo
    from lpac.sim.scenario import Scenario
    from lpac.sim.usual import judgement, usual_points

    out.mkdir(parents=True, exist_ok=True)
    scenarios = [
        ("LPAC", Scenario(seed=seed)),
        ("LPAC, 30 % loss", Scenario(seed=seed, loss=0.3)),
        ("Decentralized CVT", Scenario(seed=seed, controller="decentralized-cvt")),
        ("Centralized CVT", Scenario(seed=seed, controller="centralized-cvt")),
        ("Lloyd, knowing the whole world", Scenario(seed=seed, controller="clairvoyant-cvt")),
    ]
    names = [name for name, _ in scenarios]
    flown = dict(zip(names, fly_showing(scenarios, DEFAULT_BUNDLE), strict=True))
    write_demo({name: (scenario, flown[name]) for name, scenario in scenarios}, out)
    costs = "; ".join(f"{name} {record.normalized[-1]:.3f}" for name, record in flown.items())
    typer.echo(f"coverage cost after 60 s over initial cost: {costs}")
    typer.echo(f"see {out / 'demo.png'}")
    policy, clairvoyant = flown[names[0]], flown[names[-1]]
    usual = usual_points(scenarios[0][1], policy.bundle_id)
    typer.echo(judgement(policy.cost[-1] / clairvoyant.cost[-1], usual))
    typer.echo(
        "next: `make fly`, or `lpac sim --vehicle mavlink --out out/fly`, flies whole robots; "
        "`lpac sim --help`"
    )
