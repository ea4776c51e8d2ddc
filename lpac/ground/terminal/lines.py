"""Lines of styled text for `lpac watch`, of exact widths in terminal cells."""

import textwrap
from collections.abc import Iterable, Sequence

from rich.cells import cell_len, set_cell_size

from edge.core.counted import counted
from lpac.ground.rendering import Span

Line = tuple[Span, ...]


def plain(lines: Iterable[Line]) -> str:
    """Join lines as plain text."""
    return "\n".join("".join(span.text for span in line).rstrip() for line in lines)


def fit(text: str, width: int, *, right: bool = False) -> str:
    """Pad the text to `width` cells, or cut it with "…"."""
    text = "".join(c if c.isprintable() else " " for c in text)
    excess = cell_len(text) - width
    if excess > 0:
        return set_cell_size(text, width - 1) + "…" if width > 0 else ""
    return " " * -excess + text if right else text + " " * -excess


def line(width: int, *spans: Span) -> Line:
    """Make a line of the spans, padded or cut to `width` cells."""
    out: list[Span] = []
    left = width
    for span in spans:
        text = fit(span.text, min(left, cell_len(span.text)))
        out.append(Span(text, span.style))
        left -= cell_len(text)
    return (*out, Span(" " * left))


def wrapped(width: int, first: Line, text: Span) -> list[Line]:
    """Wrap the text after `first`, indented, on as many lines as it needs."""
    indent = sum(cell_len(span.text) for span in first)
    parts = textwrap.wrap(text.text, max(width - indent, 1)) or [""]
    starts = [first, *[(Span(" " * indent),)] * (len(parts) - 1)]
    return [
        line(width, *start, Span(part, text.style))
        for start, part in zip(starts, parts, strict=True)
    ]


def some(names: Sequence[str], width: int) -> str:
    """As many names as fit, and the number of the others."""
    for count in range(len(names), 0, -1):
        more = len(names) - count
        text = " ".join(names[:count]) + (f" +{more}" if more else "")
        if cell_len(text) <= width:
            return text
    return counted(len(names), "robot") if len(names) > 1 else "".join(names)
