"""`lpac sim` and `lpac demo`: a swarm in this process."""

import gc
import json
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from sim.experiment import Flight, Scenario

DEFAULT_BUNDLE = Path(__file__).resolve().parents[1] / "policies" / "lpac_l2_k3_n10_512"


class Controller(StrEnum):
    """Who flies the swarm."""

    LPAC = "lpac"
    DECENTRALIZED_CVT = "decentralized-cvt"
    CENTRALIZED_CVT = "centralized-cvt"
    CLAIRVOYANT_CVT = "clairvoyant-cvt"


class Scale(StrEnum):
    """How large the model's world is in the air."""

    FIELD = "field"
    MODEL = "model"


def sim(
    *,
    bundle: Annotated[Path, typer.Option(help="Policy bundle.")] = DEFAULT_BUNDLE,
    controller: Annotated[Controller, typer.Option(help="Who flies.")] = Controller.LPAC,
    robots: Annotated[int, typer.Option(help="Number of robots.")] = 10,
    seed: Annotated[int, typer.Option(help="World, starts, clocks and losses follow from it.")] = 0,
    world: Annotated[
        Path | None, typer.Option(help="CoverageControl world file (.env) instead of a random one.")
    ] = None,
    features: Annotated[int, typer.Option(help="Features of a random world.")] = 10,
    duration: Annotated[float, typer.Option(help="Flight time, s.")] = 60.0,
    scale: Annotated[
        Scale, typer.Option(help="field: 16 units per m, velocity x 0.25; model: 1 and 1.")
    ] = Scale.FIELD,
    loss: Annotated[float, typer.Option(help="Probability that a message is lost.")] = 0.0,
    delay: Annotated[float, typer.Option(help="Mean delay of a message, s.")] = 0.0,
    max_message_age: Annotated[
        float, typer.Option(help="Older messages are not used, s; 0: each is used once.")
    ] = 0.8,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the flight, its world and a figure.")
    ] = None,
) -> None:
    """Fly a swarm over an unknown world in simulated time and print how well it covers it."""
    from edge.core.frames import ModelScale
    from edge.core.world import parse_world
    from sim.experiment import FIELD_SCALE, Scenario

    scenario = Scenario(
        controller=controller.value,
        robots=robots,
        seed=seed,
        duration_s=duration,
        features=parse_world(_text(world), str(world)) if world else None,
        random_feature_count=features,
        scale=FIELD_SCALE if scale is Scale.FIELD else ModelScale(1.0, 1.0),
        loss=loss,
        delay_s=delay,
        max_message_age_s=max_message_age,
    )
    if out:
        out.mkdir(parents=True, exist_ok=True)
    [flight] = _fly([(controller.value, scenario)], bundle)
    if out:
        from sim.report import write_flight

        write_flight(flight, out)
    if as_json:
        typer.echo(json.dumps(flight.summary(), indent=2))
        return
    result = (
        f"after {duration:g} s the coverage cost is {flight.normalized_cost[-1]:.3f} "
        "of the initial cost"
        if flight.importance.any()
        else "the world has no importance anywhere, so that there was nothing to cover"
    )
    typer.echo(f"{controller.value}, {robots} robots, seed {seed}: {result}")
    if out:
        typer.echo(f"see {out / 'flight.png'}")


def demo(
    *,
    out: Annotated[Path, typer.Option(help="Folder for the figure and the flights.")] = Path(
        "out/demo"
    ),
    seed: Annotated[int, typer.Option(help="World, starts, clocks and losses follow from it.")] = 7,
) -> None:
    """Ten robots over an unknown world for 60 s, beside the baselines; makes a figure of it."""
    from sim.experiment import Scenario
    from sim.report import write_demo

    out.mkdir(parents=True, exist_ok=True)
    scenarios = [
        ("LPAC", Scenario(seed=seed)),
        ("LPAC, 30 % loss", Scenario(seed=seed, loss=0.3)),
        ("Decentralized CVT", Scenario(seed=seed, controller="decentralized-cvt")),
        ("Centralized CVT", Scenario(seed=seed, controller="centralized-cvt")),
        ("Clairvoyant CVT", Scenario(seed=seed, controller="clairvoyant-cvt")),
    ]
    names = [name for name, _ in scenarios]
    flights = dict(zip(names, _fly(scenarios, DEFAULT_BUNDLE), strict=True))
    write_demo(flights, out)
    costs = "; ".join(
        f"{name} {flight.normalized_cost[-1]:.3f}" for name, flight in flights.items()
    )
    typer.echo(f"coverage cost after 60 s over initial cost: {costs}")
    typer.echo(f"see {out / 'demo.png'}")


def _fly(scenarios: list[tuple[str, "Scenario"]], bundle_path: Path) -> list["Flight"]:
    """Simulate the named scenarios with a progress bar for each, on stderr."""
    from rich.console import Console
    from rich.progress import Progress

    from edge.runtime.bundle import load_bundle
    from sim.experiment import fly

    bundle = load_bundle(bundle_path)
    gc.freeze()  # what is loaded by now stays: not to be looked through during the flight
    flights = []
    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        for name, scenario in scenarios:
            task = progress.add_task(name, total=scenario.duration_s)
            flights.append(fly(scenario, bundle, partial(_show, progress, task)))
    return flights


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: is not a text file") from None


def _show(progress: "Progress", task: "TaskID", time_s: float) -> None:
    progress.update(task, completed=time_s)
