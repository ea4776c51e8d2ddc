"""`lpac log`: trials in logs, and repair of damaged logs."""

import json
from pathlib import Path
from typing import Annotated

import typer

from lpac.cli.apps import AsJson, new_app

app = new_app("log", "List the trials in logs, and repair damaged logs.")

# Keys: program's name, its boot nonce, trial.
_Uptimes = dict[tuple[str, str, str], tuple[float, float]]


@app.command()
def trials(
    folder: Annotated[Path, typer.Argument(help="Folder of logs (*.mcap).")],
    as_json: AsJson = False,
) -> None:
    """List the trials, and when they were flown.

    In JSON: file -> trial -> [first, last] Unix time, s; the time without a trial is under "".
    """
    from edge.drivers.log_reader import FlightLogError

    uptimes: dict[Path, _Uptimes] = {}
    began_s: dict[tuple[str, str], float] = {}
    for path in sorted(folder.rglob("*.mcap")):
        try:
            uptimes[path] = _uptimes(path, began_s)
        except FlightLogError as error:
            # Power may have failed before the first byte was on the disk.
            _say(f"{error}: left out")
    found: dict[str, dict[str, tuple[float, float]]] = {}
    for path, times in uptimes.items():
        trials = found[str(path.relative_to(folder))] = {}
        for (name, nonce, trial), span_s in times.items():
            first_s, last_s = (began_s[name, nonce] + uptime_s for uptime_s in span_s)
            before_s, after_s = trials.get(trial, (first_s, last_s))
            trials[trial] = (min(first_s, before_s), max(last_s, after_s))
    if as_json:
        typer.echo(json.dumps(found, indent=2))
        return
    for file, trials in found.items():
        for trial, (first_s, last_s) in trials.items():
            typer.echo(f"{file}  {_span(first_s, last_s)}  {trial or '-'}")


def _uptimes(path: Path, began_s: dict[tuple[str, str], float]) -> _Uptimes:
    """First and last uptime of each program and trial in a file, s. Raises FlightLogError.

    Uptime never jumps, unlike the robots' clocks. `began_s` gets each program's start by the last
    state of its clock.
    """
    from edge.drivers.log_reader import read

    times: _Uptimes = {}
    for _, time_s, status in read(path, "status", on_gap=_say):
        uptime_s = status.get("uptime_s")
        program = (path.stem.rpartition("-")[0], str(status.get("boot_nonce")))
        if not (isinstance(uptime_s, float | int) and 0.0 <= uptime_s <= time_s):
            # Without a valid uptime, only the clock is left.
            program, uptime_s = (program[0], ""), time_s
        began_s[program] = time_s - uptime_s
        key = (*program, str(status.get("trial", "")))
        first_s, last_s = times.get(key, (uptime_s, uptime_s))
        times[key] = (min(first_s, uptime_s), max(last_s, uptime_s))
    return times


@app.command()
def repair(
    log: Annotated[Path, typer.Argument(help="A damaged log (*.mcap).")],
    out: Annotated[Path, typer.Argument(help="The new file to write.")],
) -> None:
    """Copy the readable parts of a damaged log, and list the gaps."""
    from edge.drivers.log_reader import repair

    count = repair(log, out, _say)
    typer.echo(f"{out}: {count:,} messages")


def _say(text: object) -> None:
    typer.echo(f"lpac: {text}", err=True)


def _span(first_s: float, last_s: float) -> str:
    from datetime import datetime

    first, last = (datetime.fromtimestamp(s).astimezone() for s in (first_s, last_s))
    ended = f"{last:%H:%M:%S}" if last.date() == first.date() else f"{last:%Y-%m-%d %H:%M:%S}"
    return f"{first:%Y-%m-%d %H:%M:%S} to {ended}"
