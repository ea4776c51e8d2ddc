"""Lines of styled text for `lpac watch`, in which nothing is wider or narrower than it should be.

Widths are those of a terminal's cells.
"""

import math
import textwrap
from collections.abc import Iterable, Sequence
from typing import Literal, NamedTuple

from rich.cells import cell_len, set_cell_size

from edge.core.counted import counted

TextStyle = Literal[
    "", "strong", "faint", "good", "calm", "busy", "foreign", "critical", "warning", "note", "bar",
    "banner",
]  # fmt: skip


class Span(NamedTuple):
    """A piece of a line."""

    text: str
    style: TextStyle = ""


Line = tuple[Span, ...]


def plain(lines: Iterable[Line]) -> str:
    """The lines without their styles."""
    return "\n".join("".join(span.text for span in line).rstrip() for line in lines)


def fit(text: str, width: int, *, right: bool = False) -> str:
    """The text in exactly `width` cells; cut where it is longer, with "…"."""
    text = "".join(c if c.isprintable() else " " for c in text)
    excess = cell_len(text) - width
    if excess > 0:
        return set_cell_size(text, width - 1) + "…" if width > 0 else ""
    return " " * -excess + text if right else text + " " * -excess


def line(width: int, *spans: Span) -> Line:
    """The spans in exactly `width` cells."""
    out: list[Span] = []
    left = width
    for span in spans:
        text = fit(span.text, min(left, cell_len(span.text)))
        out.append(Span(text, span.style))
        left -= cell_len(text)
    return (*out, Span(" " * left))


def wrapped(width: int, first: Line, text: Span) -> list[Line]:
    """The text after `first`, on as many lines as it needs; nothing of it is cut."""
    indent = sum(cell_len(span.text) for span in first)
    parts = textwrap.wrap(text.text, max(width - indent, 1)) or [""]
    starts = [first, *[(Span(" " * indent),)] * (len(parts) - 1)]
    return [
        line(width, *start, Span(part, text.style))
        for start, part in zip(starts, parts, strict=True)
    ]


# Numbers


def number(value: float | None, width: int, decimals: int = 1) -> str:
    """As many decimals as there is room for; "-" for what is not known, ">99" beyond the width."""
    if value is None or not math.isfinite(value):
        return "-".rjust(width)
    for places in range(decimals, -1, -1):
        # Adding 0 turns -0.0 into 0.0.
        text = f"{round(value, places) + 0.0:.{places}f}"
        if len(text) <= width:
            return text.rjust(width)
    return ">" + "9" * (width - 1) if value > 0.0 else "<-" + "9" * (width - 2)


def direction(heading_deg: float, decimals: int = 0) -> str:
    """Below 360°, also rounded."""
    return f"{round(heading_deg, decimals) % 360.0:.{decimals}f}°"


def age(value_s: float | None) -> str:
    """Three characters: seconds, or with a unit minutes or hours."""
    if value_s is None or not math.isfinite(value_s):
        return "  -"
    if value_s < 9.95:
        return f"{max(value_s, 0.0):.1f}"
    if value_s < 999.5:
        return f"{value_s:3.0f}"
    minutes = value_s / 60.0
    return f"{minutes:2.0f}m" if minutes < 99.5 else f"{min(minutes / 60.0, 99.0):2.0f}h"


def duration(value_s: float) -> str:
    """Such as 02:05, or 1:02:05."""
    minutes, seconds = divmod(int(max(value_s, 0.0)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes:02}:{seconds:02}"


def some(names: Sequence[str], width: int) -> str:
    """As many of the names as fit, and how many more there are."""
    for count in range(len(names), 0, -1):
        more = len(names) - count
        text = " ".join(names[:count]) + (f" +{more}" if more else "")
        if cell_len(text) <= width:
            return text
    return counted(len(names), "robot") if len(names) > 1 else "".join(names)
