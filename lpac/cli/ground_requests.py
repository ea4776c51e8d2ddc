"""Requests to the ground, with progress and a table of the results."""

import dataclasses
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from lpac.cli.printing import BAD, FAINT, GOOD, LiveView, print_table, styled

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

    from lpac.ground.site import Standing
    from lpac.ground.station.protocol import CommandProgress, CommandReport, Request
    from lpac.ground.station.subscriber import GroundSubscriber


ListenSeconds = Annotated[
    float, typer.Option("--seconds", min=0.5, max=600, help="How long to listen.")
]


class Addressed(NamedTuple):
    """A fleet's name and file, and the addressed robots; () means all robots with a slot."""

    fleet: str
    path: Path
    robots: tuple[str, ...]


def address(path: Path, robots: str | None) -> Addressed:
    """Resolve a command's robots. Raises ConfigError for an unknown one, or without fleet.toml."""
    from lpac.fleet.settings import load_fleet, select

    config = load_fleet(path)
    chosen = () if robots is None else tuple(robot.name for robot in select(config, robots))
    return Addressed(config.fleet, path, chosen)


Details = Mapping[str, Mapping[str, object]]


def ask(
    to: Addressed, request: "Request", name: str, *, as_json: bool, details: Details | None = None
) -> None:
    """Send a command, and print each robot's result.

    `details` are more columns, by robot and heading. Raises ValueError unless all succeeded.
    """
    from lpac.ground.station.client import command
    from lpac.ground.station.protocol import SafetyCommand

    left = f"robots that were ordered to {name} do so" if isinstance(request, SafetyCommand) else ""
    with interruptible(name, left), _progress() as on_progress:
        report = command(to.fleet, request, on_progress)
    show(to, report, name, as_json=as_json, details=details or {})


def show(
    to: Addressed, report: "CommandReport", name: str, *, as_json: bool, details: Details
) -> None:
    """Print a command's report. Raises ValueError unless all succeeded."""
    from edge.core.counted import counted

    if as_json:
        robots = {
            r.robot: {"done": r.done, "code": r.code, "text": r.text, **details.get(r.robot, {})}
            for r in report.results
        }
        problem = report.problem and dataclasses.asdict(report.problem)
        print_json({"fleet": to.fleet, "problem": problem, "robots": robots})
    elif report.results:
        headings = list(dict.fromkeys(key for detail in details.values() for key in detail))
        rows: list[list[str | Text]] = [
            [
                r.robot,
                *(str(details.get(r.robot, {}).get(key, "")) for key in headings),
                styled("done", GOOD) if r.done else styled("FAILED", BAD),
                r.text,
            ]
            for r in report.results
        ]
        print_table(("robot", *headings, "result", ""), rows, headings)
    if report.problem is not None:
        raise ValueError(f"{name}: {report.problem.text}")
    failed = [r.robot for r in report.results if not r.done]
    if failed:
        count = len(report.results)
        raise ValueError(
            f"{name}: {count - len(failed)} of {counted(count, 'robot')} did it; failed: "
            f"{', '.join(failed)}"
        )


def subscribe(to: Addressed) -> "GroundSubscriber":
    """Subscribe to the ground; returns a context manager. Raises GroundError."""
    from lpac.ground.station.subscriber import GroundSubscriber

    return GroundSubscriber(to.fleet)


def measure(
    subscriber: "GroundSubscriber", robots: Sequence[str], seconds: float
) -> dict[str, "Standing"]:
    """Average the robots' positions and headings. Raises ValueError if one is missing."""
    from lpac.ground.procedure import collect_statuses
    from lpac.ground.site import standing
    from lpac.ground.station.subscriber import addressed

    names = addressed(subscriber.setup, robots)
    typer.echo(f"listening to {', '.join(names)} for {seconds:g} s", err=True)
    with interruptible("listening"):
        heard = subscriber.carry_out(collect_statuses(subscriber, names, seconds))
    return {name: standing(name, heard[name]) for name in names}


@contextmanager
def interruptible(name: str, left: str = "") -> Iterator[None]:
    """On Ctrl-C, print one line and exit with code 130; `left` says what continues."""
    try:
        yield
    except KeyboardInterrupt:
        text = left or "what was not ordered yet is not done"
        typer.echo(f"lpac: {name}: interrupted: {text}", err=True)
        raise typer.Exit(130) from None


def confirm(question: str, name: str, *, yes: bool) -> None:
    """Ask for confirmation, unless `yes`. Raises ValueError if it is denied."""
    if yes:
        return
    if not sys.stdin.isatty():
        raise ValueError(f"{name} asks first, and there is no terminal: add --yes")
    if not typer.confirm(question, err=True):
        raise ValueError(f"{name}: nothing was done")


def print_json(mapping: dict[str, object]) -> None:
    """Print one object on stdout."""
    typer.echo(json.dumps(mapping, indent=2))


@contextmanager
def _progress() -> Iterator[Callable[["CommandProgress"], None]]:
    """Progress on stderr: a live table, or a line per step without a terminal."""
    newest: dict[str, str] = {}

    def table() -> "Table":
        from rich.table import Table

        rows = Table.grid(padding=(0, 2, 0, 0))
        for robot, text in newest.items():
            rows.add_row(styled(robot, ""), styled(text, FAINT))
        return rows

    def status_line() -> str:
        lines = [f"{robot}  {text}".strip() for robot, text in list(newest.items())]
        return "; ".join(lines) or "nothing yet"

    def on_progress(progress: "CommandProgress") -> None:
        newest[progress.robot] = progress.text
        if not view.is_live:
            view.line(f"{progress.robot}  {progress.text}".strip())

    view = LiveView(table, status_line)
    with view.shown():
        yield on_progress
