"""`lpac train`: from a configuration to a policy."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import AsJson, Ray, existing, folder_lock, pool
from lpac.cli.printing import print_table, progress_of_run, time_left

if TYPE_CHECKING:
    from collections.abc import Callable

    from lpac.train.progress import RunProgress

app = new_app()

_OUT = Path("out/train")


@app.command()
def train(
    *,
    config: Annotated[Path, typer.Argument(callback=existing, help="The training: see examples/.")],
    out: Annotated[
        Path | None,
        typer.Option(help="Output folder; out/train and the policy's name if none."),
    ] = None,
    ray: Ray = None,
    as_json: AsJson = False,
) -> None:
    """Train a policy, or continue where a training stopped, keeping the weights that fly best."""
    from lpac.train.config import read_config
    from lpac.train.run import TrainingRun

    read = read_config(config)
    cores = pool(ray)
    folder = out or _OUT / read.config.export.name
    with folder_lock("the training", folder), _progress() as on_progress:
        results = TrainingRun(read, folder, on_progress).run(cores)
    if as_json:
        typer.echo(json.dumps(results, indent=2))
    else:
        _show(results)


@contextmanager
def _progress() -> "Iterator[Callable[[RunProgress], None]]":
    with progress_of_run() as show:

        def on_progress(now: "RunProgress") -> None:
            numbers = [*numbers_of_training(now), *time_left(now.left_s)]
            show(now.done, f"round {now.round}: {now.stage}", numbers)

        yield on_progress


def numbers_of_training(now: "RunProgress") -> list[str]:
    """Text of the known numbers."""
    loss = [] if now.loss is None else [f"loss {now.loss:.3f}"]
    return loss if now.cost is None else [*loss, f"closed-loop cost {now.cost:.3f}"]


def _show(results: dict[str, Any]) -> None:
    selected = results["selected"]
    rows = [
        [name, *(f"{cost[key]:.3f}" for key in ("mean", "p90", "worst"))]
        for name, cost in ((results["bundle"], selected), *results["baselines"].items())
    ]
    typer.echo("validation worlds: cost at the end over that at the start\n")
    print_table(("", "mean", "p90", "worst"), rows, right=("mean", "p90", "worst"))
    hours = results["hours"]
    typer.echo(
        f"\nround {selected['round']}, epoch {selected['epoch']}, of "
        f"{len(results['candidates'])} candidates; {results['states']} states; hours: "
        f"{hours['generate_cpu']:.2f} CPU to generate, {hours['fit']:.2f} to fit, "
        f"{hours['select']:.2f} to select\nsee {results['folder']}: README.md, the model card"
    )
