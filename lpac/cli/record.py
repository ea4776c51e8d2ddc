"""`lpac record`: a log of the ground's statuses, commands and costs."""

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
    """Log statuses, commands and costs from `lpac ground`, until Ctrl-C."""
    from lpac.fleet.settings import load_fleet
    from lpac.ground.record import record as record_to

    name = load_fleet(fleet).fleet
    directory = (fleet.parent / "logs") if out is None else out
    if sys.stdout.isatty():
        record_to(name, directory, _say, _say)
    else:
        record_to(name, directory, _say)


def _say(text: str) -> None:
    with contextlib.suppress(OSError):  # A closed pipe must not end the recording.
        typer.echo(text)
