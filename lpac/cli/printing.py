"""Tables, notes, colours and progress for all commands."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.progress import Progress
    from rich.table import Table
    from rich.text import Text

GOOD, BAD, NOTABLE, FAINT = "green", "red", "yellow", "dim"
# Colours of the styles of `lpac.ground.rendering`.
STYLES = {
    "": "", "good": GOOD, "calm": NOTABLE, "busy": NOTABLE, "foreign": NOTABLE, "faint": FAINT,
    "critical": BAD, "warning": NOTABLE, "note": FAINT,
}  # fmt: skip

# Period of progress lines without a terminal, s.
LINE_EVERY_S = 10.0


def print_table(
    headings: Sequence[str], rows: Sequence[Sequence["str | Text"]], right: Sequence[str] = ()
) -> None:
    """Print a table on stdout; columns in `right` are right-aligned.

    Names in the first column are never broken, unless they have spaces: people type them again.
    """
    from rich.console import Console

    console = Console(highlight=False)
    table = new_table(narrow=console.width < 100)
    for heading in headings:
        table.add_column(heading, justify="right" if heading in right else "left", overflow="fold")
    table.columns[0].no_wrap = not any(" " in str(row[0]) for row in rows)
    for row in rows:
        table.add_row(*(plain(cell) if isinstance(cell, str) else cell for cell in row))
    console.print(table)


def print_notes(notes: Sequence[tuple[str, "str | Text"]]) -> None:
    """Print a line per note, with its robot's name, below a table."""
    from rich.console import Console

    console = Console(highlight=False)
    grid = new_table(narrow=False, heading=False)
    for name, note in notes:
        grid.add_row(plain(name), plain(note) if isinstance(note, str) else note)
    if notes:
        console.print()
        console.print(grid)


def styled(text: str, style: str) -> "Text":
    """A cell or note in colour, without rich's markup."""
    from rich.text import Text

    return Text(text, style)


def plain(text: str) -> "Text":
    return styled(text, "")


def new_table(*, narrow: bool, heading: bool = True) -> "Table":
    from rich.table import Table

    return Table(
        box=None,
        show_header=heading,
        header_style="bold",
        pad_edge=False,
        padding=(0, 1 if narrow else 2, 0, 0),
    )


@contextmanager
def periodic_lines(status_line: Callable[[], str]) -> Iterator[None]:
    """Within this context, print `status_line()` on stderr every `LINE_EVERY_S`.

    If lines were printed and the last one has changed, it is also printed at the end. `status_line`
    is called in another thread.
    """
    ended = threading.Event()
    last = ""

    def print_lines() -> None:
        nonlocal last
        # A closed pipe must not end the work.
        with suppress(OSError):
            while not ended.wait(LINE_EVERY_S):
                last = status_line()
                typer.echo(last, err=True)

    thread = threading.Thread(target=print_lines, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
    if last and status_line() != last:
        with suppress(OSError):
            typer.echo(status_line(), err=True)


class LiveView:
    """Progress on stderr: `render` live on a terminal, else lines of `status_line`.

    Without `live` a terminal gets lines too, for example with JSON on stdout.
    """

    def __init__(
        self, render: Callable[[], "RenderableType"], status_line: Callable[[], str], *,
        live: bool = True,
    ) -> None:  # fmt: skip
        from rich.console import Console
        from rich.live import Live

        self._console = Console(stderr=True, highlight=False, markup=False)
        self._live = Live(get_renderable=render, console=self._console, transient=True)
        self._status_line = status_line
        self.is_live = live and self._console.is_terminal
        self._began_s = time.monotonic()

    def line(self, text: str) -> None:
        """Print a permanent line with the time since the view began."""
        self._console.print(self._timed(text), soft_wrap=True)

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Show the view within this context."""
        lines = periodic_lines(lambda: self._timed(self._status_line()))
        with self._live if self.is_live else lines:
            yield

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Stop the live view within this context, for a question."""
        self._live.stop()
        yield
        if self.is_live:
            self._live.start()

    def _timed(self, text: str) -> str:
        return f"{time.monotonic() - self._began_s:6.1f} s  {text}"


@contextmanager
def progress_of(what: str) -> Iterator["Progress"]:
    """Progress on stderr: done of total, time left, and each task's description."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    progress = Progress(
        TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
        TextColumn("{task.description}"), console=Console(stderr=True), transient=True,
    )  # fmt: skip

    def status_line() -> str:
        running = [task for task in progress.tasks if not task.finished] or progress.tasks[-1:]
        texts = []
        for task in running:
            of = "" if task.total is None else f" of {task.total:g}"
            left = [] if task.finished else time_left(task.time_remaining)
            parts = (f"{what} {task.completed:g}{of}", *left, task.description)
            texts.append(", ".join(filter(None, parts)))
        return "; ".join(texts) or what

    with _shown(progress, status_line):
        yield progress


@contextmanager
def progress_of_run() -> Iterator[Callable[[float, str, Sequence[str]], None]]:
    """Progress bar on stderr for a long run: present stage, share done, numbers."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    progress = Progress(
        TextColumn("{task.fields[stage]:<20}"), BarColumn(), TaskProgressColumn(),
        TextColumn("{task.fields[numbers]}"), console=Console(stderr=True), transient=True,
    )  # fmt: skip
    task = progress.add_task("", total=1.0, stage="begins", numbers="")

    def show(done: float, stage: str, numbers: Sequence[str]) -> None:
        progress.update(task, completed=done, stage=stage, numbers="  ".join(numbers))

    def status_line() -> str:
        now = progress.tasks[0]
        parts = (now.fields["stage"], f"{now.percentage:.0f} %", now.fields["numbers"])
        return "  ".join(filter(None, parts))

    with _shown(progress, status_line):
        yield show


@contextmanager
def working(text: str) -> Iterator[None]:
    """Show `text` on stderr within this context."""
    from rich.console import Console

    console = Console(stderr=True, highlight=False, markup=False)
    with console.status(text) if console.is_terminal else periodic_lines(lambda: text):
        yield


def _shown(progress: "Progress", status_line: Callable[[], str]) -> AbstractContextManager[object]:
    return progress if progress.console.is_terminal else periodic_lines(status_line)


def time_left(left_s: float | None) -> list[str]:
    """Text of the time left, in a list; empty if it is unknown."""
    if left_s is None:
        return []
    minutes = round(left_s / 60.0)
    if minutes == 0:
        return ["less than 1 min left"]
    return [
        f"{minutes // 60}:{minutes % 60:02d} h left" if minutes >= 60 else f"{minutes} min left"
    ]
