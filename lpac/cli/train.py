"""`lpac train`: from a configuration to a policy."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import AsJson, Ray, pool
from lpac.cli.printing import print_table

if TYPE_CHECKING:
    from collections.abc import Callable

    from lpac.train.progress import RunProgress

app = new_app()

_OUT = Path("out/train")
# The name of a lock has some hundred bytes.
_LOCK_BYTES = 80


@app.command()
def train(
    *,
    config: Annotated[Path, typer.Argument(help="What to train: see examples/.")],
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for all that is made; out/train and the policy's name if none."),
    ] = None,
    ray: Ray = None,
    as_json: AsJson = False,
) -> None:
    """Train a policy, or go on with it where it was stopped; chosen by how it flies."""
    from edge.drivers.process_lock import ProcessLock
    from lpac.train.config import read_config
    from lpac.train.run import TrainingRun

    read = read_config(config)
    cores = pool(ray)
    folder = out or _OUT / read.config.export.name
    with (
        ProcessLock(f"the training in {_last_part(folder)}"),
        _progress() as tell,
    ):
        told = TrainingRun(read, folder, tell).run(cores)
    if as_json:
        typer.echo(json.dumps(told, indent=2))
    else:
        _show(told)


def _last_part(folder: Path) -> str:
    return bytes(folder.resolve())[-_LOCK_BYTES:].decode(errors="ignore")


@contextmanager
def _progress() -> "Iterator[Callable[[RunProgress], None]]":
    """One bar for the whole run, on stderr."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    with Progress(
        TextColumn("{task.fields[stage]:<20}"), BarColumn(), TaskProgressColumn(),
        TextColumn("{task.fields[numbers]}"), console=Console(stderr=True), transient=True,
    ) as progress:  # fmt: skip
        task = progress.add_task("", total=1.0, stage="", numbers="")

        def tell(now: "RunProgress") -> None:
            numbers = [
                f"loss {now.loss:.3f}" if now.loss is not None else "",
                f"closed-loop cost {now.cost:.3f}" if now.cost is not None else "",
                f"{_duration(now.left_s)} left" if now.left_s is not None else "",
            ]
            progress.update(
                task, completed=now.done, stage=f"round {now.round}: {now.stage}",
                numbers="  ".join(filter(None, numbers)),
            )  # fmt: skip

        yield tell


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60.0)
    return f"{minutes // 60}:{minutes % 60:02d} h" if minutes >= 60 else f"{minutes} min"


def _show(told: dict[str, Any]) -> None:
    rows = [
        [name, *(f"{cost[key]:.3f}" for key in ("mean", "p90", "worst"))]
        for name, cost in ((told["bundle"], told["selected"]), *told["baselines"].items())
    ]
    typer.echo("validation worlds: cost at the end over that at the start\n")
    print_table(("", "mean", "p90", "worst"), rows, right=("mean", "p90", "worst"))
    hours = told["hours"]
    typer.echo(
        f"\nround {told['selected']['round']}, epoch {told['selected']['epoch']}, of "
        f"{len(told['candidates'])} candidates; {told['states']} states; hours: "
        f"{hours['generate_cpu']:.2f} CPU to generate, {hours['fit']:.2f} to fit, "
        f"{hours['select']:.2f} to select\nsee {told['folder']}: README.md, the model card"
    )
