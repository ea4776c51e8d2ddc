"""`lpac record`: a log of what the ground tells."""

import contextlib
import sys
from pathlib import Path
from typing import Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import DEFAULT_FLEET, Fleet

app = new_app()


@app.command()
def record(
    fleet: Fleet = DEFAULT_FLEET,
    out: Annotated[
        Path | None, typer.Option(help="Folder; else `logs` beside the fleet's description.")
    ] = None,
) -> None:
    """Write what `lpac ground` tells to a log, until Ctrl-C: statuses, commands, costs."""
    from lpac.fleet.settings import load_fleet
    from lpac.ground.record import record as record_to

    name = load_fleet(fleet).fleet
    directory = (fleet.parent / "logs") if out is None else out
    if sys.stdout.isatty():
        record_to(name, directory, _say, _say)
    else:
        record_to(name, directory, _say)


def _say(text: str) -> None:
    with contextlib.suppress(OSError):  # Nobody reads it: no reason to record no more.
        typer.echo(text)
