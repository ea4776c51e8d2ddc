"""The report as one HTML page that holds everything: it opens anywhere, without a network."""

import base64
import html
import math
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import NamedTuple

from edge.core import F64
from edge.core.counted import counted
from lpac.analysis.flight import LOOPS, FlightRecord, LoopLateness

_CAPTIONS = {
    "snapshots": "Robots, their paths so far and Voronoi cells over the density, which is faint "
    "where no robot had looked by then.",
    "start-and-end": "Where the robots began and ended the mission.",
    "cost": "Coverage cost over that at the beginning, beside what Lloyd's algorithm reaches with "
    "knowledge of the whole density: for comparison, not a lower bound.",
    "states": "What each robot did. Dashed lines: beginning and end of the mission.",
    "messages": "Messages between the robots during the mission: their age on arrival, and the "
    "share that did not arrive, as gaps in the senders' numbering show.",
    "loops": "How late the loops' ticks were, in the minute before each time.",
}
_MOST_ROWS = 30
_REPEATABILITY = "Cost of all missions, their mean and standard deviation; and end positions."

_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff;
  max-width: 62rem; margin: 0 auto; padding: 1rem 1rem 4rem; }
h1 { font-size: 1.7rem; margin: .5rem 0; }
h2 { font-size: 1.3rem; margin: 3rem 0 .3rem; border-top: 2px solid #1a1a1a; padding-top: .6rem; }
h3, summary { font-size: 1rem; font-weight: 600; margin: 1.5rem 0 .3rem; }
p { margin: .3rem 0; overflow-wrap: anywhere; }
.quiet, figcaption { color: #555; font-size: .9rem; }
figure { margin: 1.2rem 0; } img { width: 100%; height: auto; display: block; }
img.narrow { max-width: 42rem; }
.wide { overflow-x: auto; } table { border-collapse: collapse; font-size: .85rem; }
th, td { text-align: left; padding: .25rem .9rem .25rem 0; border-bottom: 1px solid #ddd;
  vertical-align: bottom; } th { font-weight: 600; line-height: 1.2; }
td.number, th.number { text-align: right; }
td.number { font-variant-numeric: tabular-nums; white-space: nowrap; }
.bad { color: #a50f15; font-weight: 600; } td:first-child { white-space: nowrap; }
@media print { h2 { break-before: page; } figure { break-inside: avoid; }
  body { max-width: none; } }
"""


class Drawn(NamedTuple):
    """A flight's record, and its figures: PNG by name."""

    record: FlightRecord
    figures: Mapping[str, bytes]


def page(
    title: str, drawn: Sequence[Drawn], repeatability: bytes | None, notes: Iterable[str]
) -> str:
    """The page's HTML."""
    parts = [opening(title), _summary([d.record for d in drawn])]
    if repeatability is not None:
        parts.append("<h3>Repeatability</h3>")
        parts.append(figure(repeatability, _REPEATABILITY))
    parts += [f'<p class="quiet">{_text(note)}</p>' for note in notes]
    for number, (record, figures) in enumerate(drawn, 1):
        parts.append(f'<h2 id="mission-{number}">{_text(record.name)}</h2>')
        parts.append(_about(record))
        for name, png in figures.items():
            caption = _CAPTIONS[name]
            if name == "messages" and record.clocks_known:
                caption += " Clocks are corrected, to a few ms."
            parts.append(figure(png, caption, narrow=name == "start-and-end"))
        parts.append(_robots(record))
        parts.append(_alarms(record))
        parts.append(_commands(record))
    parts.append(CLOSING)
    return "\n".join(part for part in parts if part) + "\n"


def opening(title: str) -> str:
    """How a page begins, its heading included."""
    return "\n".join(
        (
            "<!doctype html>",
            f'<html lang="en"><head><meta charset="utf-8"><title>{_text(title)}</title>',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<style>{_STYLE}</style></head><body>",
            f"<h1>{_text(title)}</h1>",
        )
    )


CLOSING = "</body></html>"


def _summary(records: Sequence[FlightRecord]) -> str:
    header = (
        "mission", "began", "s", "robots", "J at begin", "J at end", "J/J(0)", "Lloyd",
        "least distance", "inside fence", "messages lost", "alarms", "restarts",
    )  # fmt: skip
    rows = []
    for number, record in enumerate(records, 1):
        cost, separation = record.cost, record.separation
        lost = math.nan if record.messages is None else record.messages.loss_share
        rows.append(
            (
                f'<a href="#mission-{number}">{_text(record.name)}</a>',
                f"{datetime.fromtimestamp(record.begin_s).astimezone():%Y-%m-%d %H:%M:%S}",
                f"{record.duration_s:.0f}",
                str(len(record.robots)),
                f"{cost[0]:.3g}" if len(cost) else "",
                f"{cost[-1]:.3g}" if len(cost) else "",
                f"{record.normalized[-1]:.2f}" if len(record.normalized) else "",
                _number(record.normalized_lloyd, "{:.2f}"),
                "" if separation is None else f"{separation.distance_m:.2f} m",
                _marked(f"{record.fence_margin_m:.2f} m", record.fence_margin_m < 0.0)
                if math.isfinite(record.fence_margin_m)
                else "",
                _number(100.0 * lost, "{:.1f} %"),
                _marked(str(len(record.alarms)), bool(record.alarms)),
                _marked(str(sum(record.restarts.values())), bool(record.restarts)),
            )
        )
    return table(header, rows, numbers=range(1, len(header)))


def _about(record: FlightRecord) -> str:
    words = [
        f"{counted(len(record.robots), 'robot')}, {record.duration_s:.0f} s, from "
        f"{datetime.fromtimestamp(record.begin_s).astimezone():%Y-%m-%d %H:%M:%S %Z}."
    ]
    if record.separation is not None:
        one, other = record.separation.robots
        words.append(
            f"Least distance by the robots' estimates: {record.separation.distance_m:.2f} m "
            f"between {one} and {other}, at {record.separation.time_s:.1f} s."
        )
    if record.true_separation is not None:
        one, other = record.true_separation.robots
        words.append(
            f"In truth: {record.true_separation.distance_m:.2f} m between {one} and {other}, at "
            f"{record.true_separation.time_s:.1f} s; {record.true_fence_margin_m:.2f} m inside the "
            f"fence; cost at the end {_number(_last(record.normalized_true), '{:.2f}')} of the "
            "initial."
        )
    if not record.clocks_known:
        words.append("Each robot's times are by its own clock: no ground log has the offsets.")
    return f"<p>{_text(' '.join(words))}</p>"


def _robots(record: FlightRecord) -> str:
    header = (
        "robot", "battery at end", *(f"{loop} late, 99 % / max" for loop in LOOPS), "overruns",
        "restarts",
    )  # fmt: skip
    rows = []
    for robot in record.robots:
        late = [record.lateness[loop].get(robot.name) for loop in LOOPS]
        battery = robot.said[-1].battery
        rows.append(
            (
                _text(robot.name),
                "" if battery is None else f"{100.0 * battery:.0f} %",
                *map(_late, late),
                str(sum(loop.overruns for loop in late if loop is not None)),
                str(record.restarts.get(robot.name, 0)),
            )
        )
    return "<h3>Robots</h3>" + table(header, rows, numbers=range(1, len(header)))


def _late(loop: LoopLateness | None) -> str:
    return "" if loop is None else f"{loop.p99_ms[-1]:.1f} / {loop.max_ms[-1]:.1f} ms"


def _alarms(record: FlightRecord) -> str:
    if not record.alarms:
        return ""
    rows = [(_time(a.time_s), _text(a.robot), _text(a.text)) for a in record.alarms]
    return "<h3>Alarms</h3>" + table(("s", "robot", "alarm"), rows, numbers=(0,))


def _commands(record: FlightRecord) -> str:
    if not record.commands:
        return ""
    rows = [
        (_time(c.time_s), _text(c.operator), _text(c.robot), _marked(_text(c.text), not c.done))
        for c in record.commands
    ]
    opened = " open" if len(rows) <= _MOST_ROWS else ""
    return (
        f"<details{opened}><summary>Commands ({len(rows)})</summary>"
        + table(("s", "who", "robot", "what"), rows, numbers=(0,))
        + "</details>"
    )


def table(header: Sequence[str], rows: Sequence[Sequence[str]], numbers: Iterable[int] = ()) -> str:
    """A table as HTML: so are `rows`; the columns in `numbers` are to the right."""
    marks = [' class="number"' if column in set(numbers) else "" for column in range(len(header))]
    lines = ['<div class="wide"><table><tr>']
    lines += [f"<th{m}>{_text(name)}</th>" for m, name in zip(marks, header, strict=True)]
    for row in rows:
        cells = (f"<td{m}>{cell}</td>" for m, cell in zip(marks, row, strict=True))
        lines.append("</tr><tr>" + "".join(cells))
    return "".join(lines) + "</tr></table></div>"


def figure(png: bytes, caption: str, *, narrow: bool = False) -> str:
    """A figure as HTML that holds its picture."""
    source = "data:image/png;base64," + base64.b64encode(png).decode("ascii")
    mark = ' class="narrow"' if narrow else ""
    return (
        f'<figure><img{mark} alt="{_text(caption)}" src="{source}">'
        f"<figcaption>{_text(caption)}</figcaption></figure>"
    )


def _marked(text: str, bad: bool) -> str:
    return f'<span class="bad">{text}</span>' if bad else text


def _last(values: F64) -> float:
    return float(values[-1]) if len(values) else math.nan


def _time(time_s: float) -> str:
    return f"{round(time_s, 1) + 0.0:.1f}"  # without a minus before 0


def _number(value: float, form: str) -> str:
    return form.format(value) if math.isfinite(value) else ""


def _text(text: str) -> str:
    return html.escape(text)
