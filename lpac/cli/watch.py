"""`lpac watch`: the fleet in a terminal."""

import dataclasses
import json
import re
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import DEFAULT_FLEET, Fleet

if TYPE_CHECKING:
    from lpac.analysis.snapshot import FleetSetup, FleetSnapshot

app = new_app()

# Without a terminal, wide enough for all columns.
_WIDE = 160


@app.command()
def watch(
    fleet: Fleet = DEFAULT_FLEET,
    once: Annotated[bool, typer.Option("--once", help="Print it once, as plain text.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print it once, as JSON.")] = False,
    screenshot: Annotated[
        Path | None, typer.Option("--screenshot", help="Save an SVG, and quit.", hidden=True)
    ] = None,
    size: Annotated[
        str, typer.Option("--size", help="Of the screenshot, such as 100x30.", hidden=True)
    ] = "100x30",
) -> None:
    """Show fleet and mission, alarms first; h holds all robots, l lands them, ? helps.

    Without a terminal it prints them once.
    """
    from lpac.fleet.settings import load_fleet

    name = load_fleet(fleet).fleet
    if screenshot is not None:
        _save_screenshot(name, screenshot, size)
    elif as_json:
        _, snapshot = _look(name)
        typer.echo(json.dumps(dataclasses.asdict(snapshot)))
    elif once or not (sys.stdin.isatty() and sys.stdout.isatty()):
        from lpac.ground.alarms import alarms
        from lpac.ground.terminal.text import full_view

        setup, snapshot = _look(name)
        width = shutil.get_terminal_size((_WIDE, 0)).columns
        typer.echo(full_view(setup, snapshot, alarms(setup, snapshot), width))
    else:
        from lpac.ground.terminal.app import Watch

        # With the mouse captured, the terminal could not select and copy text.
        Watch(name).run(mouse=False)


def _save_screenshot(fleet: str, path: Path, size: str) -> None:
    from lpac.ground.terminal.app import Watch

    columns_and_lines = re.fullmatch(r"([1-9]\d{1,3})x([1-9]\d{1,3})", size)
    if columns_and_lines is None:
        raise ValueError(f"--size {size}: must be columns x lines, such as 100x30")
    across, down = map(int, columns_and_lines.groups())
    with path.open("w") as file:
        # Raises GroundError without a ground process.
        _look(fleet)
        app = Watch(fleet, screenshot=True)
        file.write(app.run(headless=True, size=(across, down)) or "")


def _look(fleet: str) -> tuple["FleetSetup", "FleetSnapshot"]:
    """The fleet's setup and newest snapshot."""
    from lpac.analysis.snapshot import FleetSetup, FleetSnapshot
    from lpac.ground.station.client import subscribe

    setup = None
    with subscribe(fleet) as answers:
        for answer in answers:
            if isinstance(answer, FleetSetup):
                setup = answer
            elif isinstance(answer, FleetSnapshot) and setup is not None:
                return setup, answer
    raise AssertionError("the subscription ends with a snapshot or an error")
