"""`lpac report`: figures, a page and numbers from flight logs."""

import json
import math
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.fields import options_of
from lpac.cli.printing import progress_of_run

if TYPE_CHECKING:
    from lpac.analysis.flight import FlightRecord

app = new_app()


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportOptions:
    """Options: logs, missions, and the report's folder."""

    folders: Annotated[
        list[Path],
        typer.Argument(metavar="DIR...", help="Where the robots' and the ground's logs are."),
    ]
    out: Annotated[Path | None, "Folder to write to; else `report` in the first DIR."] = None
    trial: Annotated[
        list[str] | None, "Only the mission of this name; may be repeated. Else all."
    ] = None
    times: Annotated[
        str | None, "When to take snapshots, s from the mission's start, such as 0,20,60."
    ] = None
    world: Annotated[Path | None, "The world file, if it is not beside the logs."] = None
    bundle: Annotated[
        Path | None, "The policy's bundle; where the robots had it, if not given."
    ] = None
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False


@app.command()
@options_of(ReportOptions)
def report(options: ReportOptions) -> None:
    """Make figures and an HTML page from flight logs, and show how well missions repeat."""
    from lpac.analysis.examination import Wanted, examine

    times_s = _times_s(options.times)
    wanted = Wanted(
        missions=tuple(options.trial or ()),
        times_s=times_s,
        world=options.world,
        bundle=options.bundle,
    )
    with progress_of_run() as show:

        def on_progress(what: str, share: float) -> None:
            show(share, what, ())

        examined = examine(options.folders, wanted, on_progress)
        # Imported only when needed: matplotlib takes a second.
        from lpac.analysis.write_report import write

        page = write(examined, options.out or options.folders[0] / "report", times_s, on_progress)
    if options.as_json:
        typer.echo(json.dumps(examined.summary(), indent=2))
        return
    for record in examined.records:
        typer.echo(_line(record))
    for note in examined.notes:
        typer.echo(f"note: {note}")
    typer.echo(f"see {page}")


def _times_s(times: str | None) -> tuple[float, ...]:
    if times is None:
        return ()
    try:
        return tuple(float(word) for word in times.split(","))
    except ValueError:
        raise ValueError(f"--times {times}: must be numbers such as 0,20,60") from None


def _line(record: "FlightRecord") -> str:
    """One line about a mission."""
    from edge.core.counted import counted

    words = [
        f"{record.name}: {datetime.fromtimestamp(record.begin_s):%Y-%m-%d %H:%M:%S}, "
        f"{counted(len(record.robots), 'robot')}, {record.duration_s:.0f} s"
    ]
    if len(record.normalized):
        words.append(f"cost {record.normalized[-1]:.2f} of the initial")
    if math.isfinite(record.normalized_lloyd):
        words.append(f"Lloyd's algorithm, knowing the world, {record.normalized_lloyd:.2f}")
    if record.separation is not None:
        words.append(f"least distance {record.separation.distance_m:.2f} m")
    if record.messages is not None and math.isfinite(record.messages.loss_share):
        words.append(f"{100.0 * record.messages.loss_share:.1f} % of the messages lost")
    for name, found in (("alarm", record.alarms), ("restart", record.restarts)):
        if found:
            words.append(counted(len(found), name))
    return ", ".join(words)
