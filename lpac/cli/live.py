"""Display of a fleet of programs while it runs: on stderr, and live on a terminal."""

import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Literal, Self

import typer

from lpac.cli.printing import BAD, LINE_EVERY_S, NOTABLE, new_table, plain, styled

if TYPE_CHECKING:
    from rich.console import Console
    from rich.live import Live
    from rich.table import Table
    from rich.text import Text

    from edge.messages.mission import RobotStatus
    from lpac.sim.fleet.listener import Statuses

_DRAW_EVERY_S = 0.5
# Between the names and the last column, which takes what is left: 27 cells of 80.
_COLUMNS: tuple[tuple[str, int, Literal["left", "right"]], ...] = (
    ("state", 9, "left"), ("x", 5, "right"), ("y", 5, "right"),
    ("height", 6, "right"), ("m/s", 4, "right"), ("hears", 5, "right"), ("battery", 7, "right"),
)  # fmt: skip


class FleetDisplay:
    """A context. `say` may be called from any thread."""

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
        """A line with the time, above the table."""
        self._told_s = self._clock()
        self._console.print(f"{self._told_s - self._began_s:6.1f} s  {text}", markup=False)

    def print(self, text: str) -> None:
        """On stdout; the table, which may be on the same terminal, goes on below it."""
        running = self._live.is_started
        self._live.stop()
        typer.echo(text)
        if running:
            # One that is started again would draw over the text.
            self._live = self._new_live()
            self._live.start()

    def _new_live(self) -> "Live":
        from rich.live import Live

        return Live(console=self._console, auto_refresh=False, transient=True)

    def show(self, step: str, statuses: "Statuses") -> None:
        """The table, where there is a terminal."""
        from rich.console import Group

        now_s = self._clock()
        if self._live.is_started and now_s - self._told_s >= _DRAW_EVERY_S:
            self._told_s = now_s
            title = plain(f"{now_s - self._began_s:.0f} s: {step}")
            table = fleet_table({f"r{r}": statuses.get(r) for r in self._robots})
            # The cursor stays behind a short line: Ctrl-C's echo breaks none then.
            self._live.update(Group(title, table, ""), refresh=True)

    def show_or_say(self, step: str, statuses: "Statuses") -> None:
        """The same; without a terminal, how many robots are in which state, every 10 s."""
        if self._live.is_started:
            self.show(step, statuses)
        elif self._clock() - self._told_s >= LINE_EVERY_S:
            states = Counter(status.state.value for status in statuses.values())
            counts = ", ".join(f"{count} {state}" for state, count in states.most_common())
            self.say(f"{step}; robots: {counts or 'not heard yet'}")


def fleet_table(statuses: "Mapping[str, RobotStatus | None]") -> "Table":
    """A line for each robot's name, whatever is in it and however wide the terminal is."""
    table = new_table(narrow=True)
    table.expand = True
    table.add_column("robot", width=max([5, *map(len, statuses)]), no_wrap=True)
    for heading, width, justify in _COLUMNS:
        table.add_column(heading, width=width, justify=justify, no_wrap=True)
    table.add_column("", ratio=1, no_wrap=True, overflow="ellipsis")
    for robot, status in statuses.items():
        cells = [styled("not heard", BAD)] if status is None else _cells(status)
        table.add_row(plain(robot), *cells)
    return table


def _cells(status: "RobotStatus") -> list["Text"]:
    from edge.messages.codes import texts
    from edge.messages.mission import FlightState

    position_m = status.position_m or ()
    speed_m_s = sum(v * v for v in (status.velocity_m_s or ())[:2]) ** 0.5
    told = (
        *(f"{metres:.1f}" for metres in position_m),
        *("" for _ in range(3 - len(position_m))),
        f"{speed_m_s:.1f}",
        str(len(status.neighbour_ages_s)),
        "" if status.battery is None else f"{100.0 * status.battery:.0f} %",
        texts(status.alarms if status.armed else status.failed_checks) or status.reason.text,
    )
    style = "" if status.state is FlightState.MISSION else NOTABLE
    return [styled(status.state.value, style), *map(plain, told)]
