"""`lpac mission run`: fly a script, and show its progress."""

import json
import signal
import sys
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.ground_requests import address, subscribe
from lpac.cli.options import DEFAULT_FLEET, Fleet
from lpac.cli.printing import LiveView

if TYPE_CHECKING:
    from rich.console import Group

    from lpac.ground.script import ScriptRun
    from lpac.ground.station.subscriber import GroundSubscriber


def run(
    script: Annotated[
        Path, typer.Argument(metavar="SCRIPT.toml", help="The script; see docs/script.toml.")
    ],
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not ask before the next trial takes off.")
    ] = False,
    fleet: Fleet = DEFAULT_FLEET,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json",
            help="Print one JSON object a line: each step when it is done, then the outcome.",
        ),
    ] = False,
) -> None:
    """Fly a script: origin, world, and trials from preflight to landing.

    If a step fails, or on Ctrl-C, the fleet is ordered to hold. Asks before each further trial.
    """
    from lpac.ground.script import ScriptRun, load_script
    from lpac.ground.site import Sites

    to = address(fleet, None)
    sites = Sites(to.path)
    loaded = load_script(script, sites)
    if loaded.trials > 1 and not yes:
        _require_terminal(f"{script}: trials = {loaded.trials}")
    # Closing the terminal ends a script as Ctrl-C does.
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)
    with subscribe(to) as subscriber:
        view = _View(subscriber, yes, as_json)
        problem, code = _fly(ScriptRun(loaded, sites, subscriber, view), view)
    typer.echo(f"lpac: {script}: {problem}" if problem else f"{script}: done", err=True)
    if as_json:
        outcome = {"script": str(script), "done": not problem, "problem": problem or None}
        typer.echo(json.dumps(outcome))
    raise typer.Exit(code)


def _require_terminal(which: str) -> None:
    if not sys.stdin.isatty():
        raise ValueError(
            f"{which}: asks before the next trial takes off, and there is no terminal: add --yes"
        )


def _fly(flight: "ScriptRun", view: "_View") -> tuple[str, int]:
    """Fly, and return the problem ("" if none) and the exit code."""
    from lpac.ground.script import ScriptError
    from lpac.ground.station.client import GroundError

    view.robots, carry_out = flight.robots, view.subscriber.carry_out
    try:
        with view.shown():
            carry_out(flight.fly())
            view.end_step()
    except ScriptError as error:
        then = f"; {carry_out(flight.hold())}" if error.hold else ""
        return f"{error}{then}", 1
    except GroundError as error:
        return f"{error}; robots in the air hold by themselves, and then land", 1
    except (KeyboardInterrupt, typer.Abort, OSError, SystemExit) as error:
        # typer aborts at a question, a closed terminal raises OSError, and rich exits when its pipe
        # breaks.
        why = str(error) if isinstance(error, OSError) else "interrupted"
        return f"{why}; {carry_out(flight.hold())}", 130
    return "", 0


class _View:
    """Progress on stderr: step, time left and robots on a terminal, else a line per step."""

    def __init__(self, subscriber: "GroundSubscriber", yes: bool, as_json: bool) -> None:
        self.subscriber = subscriber
        self.robots: tuple[str, ...] = ()
        self._yes, self._as_json = yes, as_json
        self._step, self._step_began_s = "", time.monotonic()
        self._at_most_s: float | None = None
        # A live view on a terminal would capture the JSON on stdout.
        self._view = LiveView(self._render, self._status_line, live=not as_json)
        self.shown, self.line = self._view.shown, self._view.line

    def step(self, name: str, at_most_s: float | None) -> None:
        """Begin a step, and end the one before."""
        self.end_step()
        self._step, self._at_most_s = name, at_most_s
        self._step_began_s = time.monotonic()
        self.line(name if at_most_s is None else f"{name}, {at_most_s:g} s")

    def end_step(self) -> None:
        """End the present step, if there is one."""
        if self._as_json and self._step:
            duration_s = round(time.monotonic() - self._step_began_s, 3)
            typer.echo(json.dumps({"step": self._step, "duration_s": duration_s}))
        self._step = ""

    def confirm(self, question: str) -> bool:
        """Ask at the terminal, between two trials."""
        self.end_step()
        if self._yes:
            return True
        with self._view.paused():
            return typer.confirm(question, err=True)

    def _status_line(self) -> str:
        """One line: the step, and the robots' states."""
        states = Counter(
            "not heard" if robot.status is None or not robot.fresh else robot.status.state.value
            for robot in self.subscriber.snapshot.robots
            if robot.name in self.robots
        )
        doing = ", ".join(f"{count} {state}" for state, count in states.items())
        return f"{self._title()}: {doing}"

    def _title(self) -> str:
        passed_s = time.monotonic() - self._step_began_s
        title = f"{self._step or 'script'}: {passed_s:.0f} s"
        if self._at_most_s is None:
            return title
        return f"{title}, {max(0.0, self._at_most_s - passed_s):.0f} s left"

    def _render(self) -> "Group":
        from rich.console import Group
        from rich.text import Text

        from lpac.cli.live import fleet_table
        from lpac.ground.alarms import alarms
        from lpac.ground.rendering import rows

        setup, snapshot = self.subscriber.setup, self.subscriber.snapshot
        shown = rows(setup, snapshot, alarms(setup, snapshot))
        table = fleet_table(row for row in shown if row.robot.name in self.robots)
        return Group(Text(self._title(), "bold"), Text("Ctrl-C holds the fleet", "bold red"), table)
