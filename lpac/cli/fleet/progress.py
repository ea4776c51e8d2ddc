"""Progress of the same task on many robots: a live table, then a summary."""

import asyncio
import json
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar, cast

import typer

from lpac.cli.printing import (
    BAD,
    FAINT,
    GOOD,
    LiveView,
    new_table,
    plain,
    print_notes,
    print_table,
    styled,
)

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

    from lpac.fleet.hold import Report
    from lpac.fleet.operations import Outcome
    from lpac.fleet.settings import FleetConfig, RobotHost

T = TypeVar("T")


_STEP_WIDTH, _BAR_WIDTH = 10, 16


def run_all(
    robots: Sequence["RobotHost"],
    task: Callable[["RobotHost"], Awaitable[T]],
    on_outcome: Callable[["Outcome[T]"], None],
) -> list["Outcome[T]"]:
    """Run `task` on all robots at once until all are done, or Ctrl-C; return outcomes in order.

    `on_outcome` is called with each as it comes.
    """
    from lpac.fleet.operations import Outcome, for_each

    finished: dict[str, Outcome[T]] = {}

    def keep(outcome: Outcome[T]) -> None:
        finished[outcome.robot.name] = outcome
        on_outcome(outcome)

    try:
        asyncio.run(for_each(robots, task, keep))
    except KeyboardInterrupt:
        for robot in robots:
            if robot.name not in finished:
                keep(Outcome(robot, None, "interrupted", interrupted=True))
    return [finished[robot.name] for robot in robots]


def run_for_each(
    robots: Sequence["RobotHost"], task: Callable[["RobotHost", "Report"], Awaitable[T]]
) -> list["Outcome[T]"]:
    """`run_all` for a task that reports its steps.

    Shows them on stderr: in a live table, or a line per step without a terminal.
    """
    progress = _Progress({robot.name: _Row(robot.name, robot.host) for robot in robots})

    async def one(robot: "RobotHost") -> T:
        return await task(robot, lambda step, share: progress.show(robot.name, step, share))

    with progress.shown():
        outcomes = run_all(robots, one, lambda o: progress.end(o.robot.name, o.problem))
    steps = {name: row.step for name, row in progress.rows.items()}
    return [
        o._replace(problem=f"interrupted at {steps[o.robot.name]}")
        if o.interrupted and steps[o.robot.name]
        else o
        for o in outcomes
    ]


def print_problems(outcomes: Sequence["Outcome[T]"]) -> None:
    """Print the problem of each robot that has one."""
    print_notes([(o.robot.name, styled(o.problem, BAD)) for o in outcomes if o.problem is not None])


def print_json(
    config: "FleetConfig",
    outcomes: Sequence["Outcome[T]"],
    describe: Callable[[T], Mapping[str, object]],
) -> None:
    """Print one object: each robot's host, `problem` (null if none), and keys of `describe`."""
    robots = {
        outcome.robot.name: {
            "host": outcome.robot.host,
            "problem": outcome.problem,
            **({} if outcome.value is None else describe(outcome.value)),
        }
        for outcome in outcomes
    }
    typer.echo(json.dumps({"fleet": config.fleet, "robots": robots}, indent=2))


def print_results(
    config: "FleetConfig",
    outcomes: Sequence["Outcome[T]"],
    done: str,
    *,
    as_json: bool,
    describe: Callable[[T], Mapping[str, object]],
    cells: Callable[[T], Sequence["str | Text"]],
    headings: Sequence[str] = (),
    numbers: Sequence[str] = (),
) -> None:
    """Print JSON, or `print_outcomes`; then `require_all`."""
    if as_json:
        print_json(config, outcomes, describe)
    else:
        print_outcomes(outcomes, cells, headings, numbers)
    require_all(outcomes, done)


def print_outcomes(
    outcomes: Sequence["Outcome[T]"],
    cells: Callable[[T], Sequence["str | Text"]],
    headings: Sequence[str] = (),
    numbers: Sequence[str] = (),
) -> None:
    """Print a row per robot: cells of `headings` and `numbers`, and the result; then problems."""
    failed = [*[""] * len((*headings, *numbers)), styled("failed", BAD)]
    rows = [
        [o.robot.name, *(failed if o.problem is not None else cells(cast(T, o.value)))]
        for o in outcomes
    ]
    print_table(("robot", *headings, *numbers, "result"), rows, numbers)
    print_problems(outcomes)


def require_all(outcomes: Sequence["Outcome[T]"], done: str) -> None:
    """Raise ValueError, such as "stopped on 2 of 3 robots; failed: r2", unless all succeeded."""
    from edge.core.counted import counted

    failed = [outcome.robot.name for outcome in outcomes if outcome.problem is not None]
    if failed:
        count = len(outcomes)
        raise ValueError(
            f"{done} {count - len(failed)} of {counted(count, 'robot')}; "
            f"failed: {', '.join(failed)}"
        )


@dataclass(slots=True)
class _Row:
    """Progress of a robot; `share` of its step is done, None if unknown."""

    name: str
    host: str
    step: str = ""
    share: float | None = None
    outcome: tuple[str, str] | None = None


class _Progress:
    def __init__(self, rows: dict[str, _Row]) -> None:
        self.rows = rows
        self._view = LiveView(self._table, self._status_line)
        self.shown = self._view.shown

    def show(self, name: str, step: str, share: float | None) -> None:
        row = self.rows[name]
        if step != row.step:
            self._line(name, step)
        row.step, row.share = step, share

    def end(self, name: str, problem: str | None) -> None:
        row = self.rows[name]
        if row.step:
            self._line(name, problem or "done")
        row.outcome = ("done", GOOD) if problem is None else (problem, BAD)

    def _status_line(self) -> str:
        """Steps of the robots that are not done, in one line."""
        return "; ".join(
            f"{row.name}  {row.step}" + ("" if row.share is None else f" {row.share:.0%}")
            for row in list(self.rows.values())
            if row.outcome is None
        )

    def _line(self, name: str, text: str) -> None:
        if not self._view.is_live:
            self._view.line(f"{name}  {text}")

    def _table(self) -> "Table":
        from rich.progress_bar import ProgressBar
        from rich.text import Text

        table = new_table(narrow=False, heading=False)
        # There may be no robots, for example if none came up.
        names = max((len(row.name) for row in self.rows.values()), default=0)
        hosts = max((len(row.host) for row in self.rows.values()), default=0)
        # Fixed widths, so that the table does not jump between steps; outcomes get the rest.
        for width in (names, hosts, _STEP_WIDTH, _BAR_WIDTH, None):
            table.add_column(no_wrap=True, min_width=width)
        for row in self.rows.values():
            bar: Text | ProgressBar = Text("")
            if row.outcome is None and row.share is not None:
                bar = ProgressBar(total=1.0, completed=row.share, width=_BAR_WIDTH)
            table.add_row(
                plain(row.name),
                styled(row.host, FAINT),
                styled(row.step, FAINT if row.outcome else ""),
                bar,
                styled(*row.outcome) if row.outcome else styled("...", FAINT),
            )
        return table
