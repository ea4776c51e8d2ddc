"""`lpac log`: what the robots' and the ground's logs hold."""

import json
from pathlib import Path
from typing import Annotated

import typer

from lpac.cli.apps import new_app

app = new_app("log", "What the robots' and the ground's logs hold.")


@app.callback()
def main() -> None:
    """So that `trials` is a command of its own."""


@app.command()
def trials(
    folder: Annotated[Path, typer.Argument(help="Folder of logs (*.mcap).")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Say which trials were flown, and when.

    In JSON: file -> trial -> [first, last] Unix time, s; the time without a trial is under "".
    """
    from datetime import datetime

    from edge.drivers.flight_log import FlightLogError, read

    found: dict[str, dict[str, tuple[float, float]]] = {}
    for path in sorted(folder.rglob("*.mcap")):
        times: dict[str, tuple[float, float]] = {}
        try:
            for _, time_s, status in read(path, "status"):
                trial = str(status.get("trial", ""))
                first_s, last_s = times.get(trial, (time_s, time_s))
                # The clock may be set meanwhile.
                times[trial] = (min(first_s, time_s), max(last_s, time_s))
        except FlightLogError as error:
            # Perhaps the power went before the first byte of it was on the disk.
            typer.echo(f"lpac: {error}: left out", err=True)
            continue
        found[str(path.relative_to(folder))] = times
    if as_json:
        typer.echo(json.dumps(found, indent=2))
        return
    for name, times in found.items():
        for trial, (first_s, last_s) in times.items():
            began, ended = (datetime.fromtimestamp(s).astimezone() for s in (first_s, last_s))
            typer.echo(f"{name}  {began:%Y-%m-%d %H:%M:%S} to {ended:%H:%M:%S}  {trial or '-'}")
