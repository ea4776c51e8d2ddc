"""`lpac ablate`: what each part of a method contributes."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import AsJson, Ray, existing, folder_lock, pool
from lpac.cli.printing import BAD, GOOD, print_table, progress_of_run, styled, time_left
from lpac.cli.train import numbers_of_training

if TYPE_CHECKING:
    from lpac.ablate.config import Ablation
    from lpac.ablate.results import VariantResult
    from lpac.ablate.run import AblationProgress

app = new_app()

_OUT = Path("out/ablate")
_STYLES = {"better": GOOD, "worse": BAD}


@app.command()
def ablate(
    *,
    ablation: Annotated[
        Path,
        typer.Argument(callback=existing, help="The ablation: see examples/ablation.toml."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="Output folder; out/ablate and the file's name if none."),
    ] = None,
    ray: Ray = None,
    as_json: AsJson = False,
) -> None:
    """Train a method without each of its parts, and measure what each contributes."""
    from lpac.ablate.config import read_ablation
    from lpac.ablate.run import AblationRun
    from lpac.ablate.summary import write_report

    read = read_ablation(ablation)
    cores = pool(ray)
    folder = out or _OUT / ablation.stem
    with folder_lock("the ablation", folder), _progress() as on_progress:
        results = AblationRun(read, folder, on_progress).run(cores)
        document = write_report(read, results, folder)
    if as_json:
        typer.echo(json.dumps(document, indent=2))
    else:
        _show(read, results, folder)


@contextmanager
def _progress() -> "Iterator[Callable[[AblationProgress], None]]":
    with progress_of_run() as show:

        def on_progress(now: "AblationProgress") -> None:
            training = now.training
            stage = f"{now.doing}: {training.stage}" if training else now.doing
            numbers = numbers_of_training(training) if training else []
            show(now.done, stage, [*numbers, *time_left(now.left_s)])

        yield on_progress


def _show(read: "Ablation", results: "list[VariantResult]", folder: Path) -> None:
    from edge.core.counted import counted
    from lpac.ablate.summary import no_claim, numbers_of

    config = read.config
    typer.echo(
        f"{counted(config.worlds, 'world')} of the {config.world_set} set from "
        f"{read.worlds.start} on, "
        f"{config.set_up}, {config.duration_s:g} s; cost at the end over that at the start\n"
    )
    columns = ("", "mean", "over seeds", "to base", "95 %", "")
    rows = [(result.variant.name, *numbers_of(result)) for result in results]
    print_table(
        columns,
        [[*row[:-1], styled(row[-1], _STYLES.get(row[-1], ""))] for row in rows],
        right=columns[1:-1],
    )
    if claim := no_claim(read):
        typer.echo(f"\n{claim}")
    if config.world_set == "test":
        typer.echo(
            f"\nthe test set was used, {counted(config.worlds, 'world')}: if you select by these "
            "results, it is no longer a test set"
        )
    typer.echo(f"\nsee {folder}: README.md, ablation.json, differences.png, and each training")
