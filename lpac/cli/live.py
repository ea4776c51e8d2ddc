"""Display of a running fleet of programs on stderr, live on a terminal."""

import time
from collections import Counter
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Self

import typer

from lpac.cli.printing import LINE_EVERY_S, STYLES, new_table, plain, styled

if TYPE_CHECKING:
    from rich.console import Console
    from rich.live import Live
    from rich.table import Table

    from edge.messages.mission import RobotStatus
    from lpac.ground.rendering import Row
    from lpac.sim.fleet.listener import Statuses

_DRAW_EVERY_S = 0.5
# Between the names and the last column, which fills the line.
_COLUMNS = ("state", "x", "y", "height", "speed", "neighbours", "battery")


class FleetDisplay:
    """Context manager; `say` may be called from any thread."""

    def __init__(
        self,
        robots: int,
        console: "Console | None" = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        from rich.console import Console

        self._robots = range(robots)
        self._console = console or Console(stderr=True, highlight=False)
        self._live = self._new_live()
        self._clock = clock
        self._began_s = self._told_s = clock()

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def say(self, text: str) -> None:
        """Print a line with the time, above the table."""
        self._told_s = self._clock()
        self._console.print(f"{self._told_s - self._began_s:6.1f} s  {text}", markup=False)

    def print(self, text: str) -> None:
        """Print on stdout, above the table."""
        running = self._live.is_started
        self._live.stop()
        typer.echo(text)
        if running:
            # The old one, restarted, would draw over the text.
            self._live = self._new_live()
            self._live.start()

    def _new_live(self) -> "Live":
        from rich.live import Live

        return Live(console=self._console, auto_refresh=False, transient=True)

    def show(self, step: str, statuses: "Statuses") -> None:
        """Draw the table, on a terminal only."""
        from rich.console import Group

        now_s = self._clock()
        if self._live.is_started and now_s - self._told_s >= _DRAW_EVERY_S:
            self._told_s = now_s
            title = plain(f"{now_s - self._began_s:.0f} s: {step}")
            table = fleet_table(_row(robot, statuses.get(robot)) for robot in self._robots)
            # An empty last line takes the echo of Ctrl-C.
            self._live.update(Group(title, table, ""), refresh=True)

    def show_or_say(self, step: str, statuses: "Statuses") -> None:
        """Draw the table; without a terminal, print the robots per state every 10 s."""
        if self._live.is_started:
            self.show(step, statuses)
        elif self._clock() - self._told_s >= LINE_EVERY_S:
            states = Counter(status.state.value for status in statuses.values())
            counts = ", ".join(f"{count} {state}" for state, count in states.most_common())
            self.say(f"{step}; robots: {counts or 'not heard yet'}")


def _row(robot: int, status: "RobotStatus | None") -> "Row":
    from lpac.analysis.snapshot import RobotSnapshot
    from lpac.ground.rendering import Row

    age_s = None if status is None else 0.0
    return Row(RobotSnapshot(f"r{robot}", robot, status, age_s))


def fleet_table(rows: "Iterable[Row]") -> "Table":
    """One line per robot, at any width of the terminal."""
    from lpac.ground.rendering import COLUMN, cell

    rows = list(rows)
    table = new_table(narrow=True)
    table.expand = True
    longest = max((len(row.robot.name) for row in rows), default=0)
    table.add_column("robot", width=max(5, longest), no_wrap=True)
    for key in _COLUMNS:
        _, _, top, unit, width, _, left = COLUMN[key]
        table.add_column(
            f"{top} {unit}".strip(), width=max(width, len(top) + 1 + len(unit)),
            justify="left" if left else "right", no_wrap=True,
        )  # fmt: skip
    table.add_column("", ratio=1, no_wrap=True, overflow="ellipsis")
    for row in rows:
        cells = [cell(row, key) for key in (*_COLUMNS, "problem")]
        table.add_row(
            plain(row.robot.name), *(styled(text.strip(), STYLES[style]) for text, style in cells)
        )
    return table
