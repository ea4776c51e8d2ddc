"""Robots in `lpac watch`: a table row each, or the details of one.

A cell is always as wide as its column, so that columns do not shift.
"""

from collections.abc import Iterable, Sequence
from itertools import zip_longest

from rich.cells import cell_len

from lpac.analysis.snapshot import FleetSetup, FleetSnapshot, RobotSnapshot
from lpac.ground.alarms import Alarm
from lpac.ground.rendering import (
    COLUMNS,
    Column,
    Row,
    Span,
    StatusTable,
    age,
    cell,
    facts,
    quantity,
    state_style,
    state_word,
    tables,
)
from lpac.ground.terminal.lines import Line, fit, line, wrapped

_NARROWEST_NAME, _WIDEST_NAME = 4, 12


def columns(setup: FleetSetup, width: int) -> tuple[Column, ...]:
    """Columns that fit; the reason gets the remaining width."""
    longest = max((cell_len(name) for name in setup.robots), default=0)
    name_width = min(max(longest, _NARROWEST_NAME), _WIDEST_NAME)
    offered = [c._replace(width=name_width) if c.key == "name" else c for c in COLUMNS]
    left, chosen = width + 1, set()
    for column in sorted(offered, key=lambda column: column.rank):
        if column.width + 1 > left:
            break
        left -= column.width + 1
        chosen.add(column.key)
    return tuple(
        column._replace(width=column.width + left) if column.key == "problem" else column
        for column in offered
        if column.key in chosen
    )


def heading(shown: Sequence[Column]) -> tuple[Line, Line]:
    """Names and units of the columns. A column without a name shares that of the one before."""
    names, units, at = "", [], 0
    for column in shown:
        name = column.top if column.left else column.top.rjust(column.width)
        names = names.ljust(at) + name if column.top else names
        units.append(fit(column.unit, column.width, right=not column.left))
        at += column.width + 1
    return line(at - 1, Span(names, "faint")), line(at - 1, Span(" ".join(units), "faint"))


def table_row(shown: Sequence[Column], row: Row) -> Line:
    """Row of a robot."""
    spans = []
    for column in shown:
        text, style = cell(row, column.key)
        spans += [Span(fit(text, column.width, right=not column.left), style), Span(" ")]
    return tuple(spans[:-1])


def detail(row: Row, snapshot: FleetSnapshot, alarms: Iterable[Alarm], width: int) -> list[Line]:
    """Details of a robot."""
    lines = [_detail_title(row.robot, width)]
    for name, text, style in facts(row, snapshot, alarms):
        lines += wrapped(width, (Span(f"{name:<10} ", "faint"),), Span(text, style))
    blocks = [_table_lines(table) for table in tables(row)]
    return [*lines, line(width), *_beside(width, *blocks)] if blocks else lines


def summary_lines(row: Row, width: int) -> tuple[Line, Line]:
    """Two lines of what may not fit into a robot's row, such as its reason and fence margin."""
    status = row.robot.status
    name = Span(f" {row.robot.name}  ", "strong")
    if status is None:
        return line(width, name, Span("never heard", "faint")), line(width)
    return (
        line(width, name, Span(status.reason.text)),
        line(
            width,
            Span(" fence margin ", "faint"), quantity(row, "margin"),
            Span("   bundle ", "faint"), quantity(row, "bundle"),
            Span("   world ", "faint"), quantity(row, "world"),
            Span("   trial ", "faint"), Span(status.trial or "-"),
        ),
    )  # fmt: skip


def _detail_title(robot: RobotSnapshot, width: int) -> Line:
    status = robot.status
    name = Span(f"{robot.name} ", "strong")
    if status is None:
        return line(width, name, Span(f"(id {robot.robot_id})", "faint"))
    heard = f"heard {age(robot.age_s).strip()} s ago"
    left = (
        name,
        Span(f"(id {robot.robot_id})  ", "faint"),
        Span(state_word(status), state_style(status).style),
        Span(f": {status.reason.text}"),
    )
    return (
        *line(width - len(heard) - 1, *left),
        Span(f" {heard}", "" if robot.fresh else "critical"),
    )


def _table_lines(table: StatusTable) -> list[Line]:
    def fitted(cells: Sequence[str]) -> str:
        pairs = enumerate(zip(cells, table.widths, strict=False))
        return " ".join(fit(text, width, right=n > 0) for n, (text, width) in pairs)

    lines: list[Line] = [(Span(fitted(table.headings), "faint"),)]
    return lines + [(Span(fitted(cells), style),) for cells, style in table.rows]


def _beside(width: int, left: Sequence[Line], right: Sequence[Line]) -> list[Line]:
    """Two blocks side by side, or one below the other if they do not fit."""
    widest = max(sum(cell_len(span.text) for span in row) for row in left)
    needed = widest + 3 + max(sum(cell_len(span.text) for span in row) for row in right)
    if needed > width:
        return [line(width, *row) for row in (*right, (), *left)]
    lines = []
    for a, b in zip_longest(left, right, fillvalue=()):
        lines.append(line(width, *line(widest + 3, *a), *b))
    return lines
