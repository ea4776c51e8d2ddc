"""Tables, notes and colours, as all commands print them."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress
    from rich.table import Table
    from rich.text import Text

GOOD, BAD, NOTABLE, FAINT = "green", "red", "yellow", "dim"


def print_table(
    headings: Sequence[str], rows: Sequence[Sequence["str | Text"]], right: Sequence[str] = ()
) -> None:
    """A table on stdout; the headings in `right` are those of columns of numbers."""
    from rich.console import Console

    console = Console(highlight=False)
    table = new_table(narrow=console.width < 100)
    for heading in headings:
        table.add_column(heading, justify="right" if heading in right else "left", overflow="fold")
    for row in rows:
        table.add_row(*(plain(cell) if isinstance(cell, str) else cell for cell in row))
    console.print(table)


def print_notes(notes: Sequence[tuple[str, "str | Text"]]) -> None:
    """Lines of a robot's name and something about it, below a table."""
    from rich.console import Console

    console = Console(highlight=False)
    grid = new_table(narrow=False, heading=False)
    for name, note in notes:
        grid.add_row(plain(name), plain(note) if isinstance(note, str) else note)
    if notes:
        console.print()
        console.print(grid)


def styled(text: str, style: str) -> "Text":
    """A cell or note in colour; brackets in it mean nothing."""
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


def progress_of(what: str) -> "Progress":
    """On stderr: how many are done of how many, the time left, and each task's description."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
        TextColumn("{task.description}"), console=Console(stderr=True), transient=True,
    )  # fmt: skip
