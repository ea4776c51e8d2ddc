"""Writes a report: figures, one HTML page, and numbers.

Separate from `examination`, since importing matplotlib takes a second.
"""

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from edge.core.counted import counted
from lpac.analysis import figures, style
from lpac.analysis.examination import Examined
from lpac.analysis.flight import LOOPS, FlightRecord, LoopLateness, RobotRecord
from lpac.analysis.logs import Progress
from lpac.analysis.template import render

PAGE = "report.html"
SUMMARY = "report.json"


class Drawn(NamedTuple):
    """A flight's record and its figures, PNG by name."""

    record: FlightRecord
    figures: Mapping[str, bytes]


def write(examined: Examined, out: Path, times_s: Sequence[float], progress: Progress) -> Path:
    """Write figures, page and summary to `out`; returns the page's path. Raises OSError."""
    drawn = []
    slugs: set[str] = set()
    for index, record in enumerate(examined.records):
        progress(f"drawing {record.name}", index / len(examined.records))
        drawn.append(Drawn(record, _draw(record, out / _slug(record.name, slugs), times_s)))
    repeatability = None
    with_cost = [record for record in examined.records if len(record.normalized)]
    if len(with_cost) > 1:
        progress("drawing all missions", 1.0)
        repeatability = style.save(figures.repeatability(with_cost), out / "repeatability")
        style.save(figures.costs(with_cost), out / "costs")
    (out / SUMMARY).write_text(json.dumps(examined.summary(), indent=2) + "\n")
    names = ", ".join(record.name for record in examined.records[:3])
    names += ", …" if len(drawn) > 3 else ""
    text = page(f"Flight report: {names}", drawn, repeatability, examined.notes)
    (out / PAGE).write_bytes(text.encode(errors="backslashreplace"))
    return out / PAGE


def page(
    title: str, drawn: Sequence[Drawn], repeatability: bytes | None, notes: Iterable[str]
) -> str:
    """HTML of the self-contained page."""
    return render(
        "lpac.analysis", "report.html", title=title, drawn=drawn, repeatability=repeatability,
        notes=notes, loops={loop: f"{loop} late, 99 % / max" for loop in LOOPS}, late=_late,
        local=_local, known=_known, counted=counted,
    )  # fmt: skip


def _late(record: FlightRecord, robot: RobotRecord) -> list[LoopLateness | None]:
    return [record.lateness[loop].get(robot.name) for loop in LOOPS]


def _local(unix_s: float) -> datetime:
    return datetime.fromtimestamp(unix_s).astimezone()


def _known(form: str, value: float) -> str:
    return form.format(value) if math.isfinite(value) else ""


def _slug(name: str, taken: set[str]) -> str:
    """A unique folder name for a mission."""
    plain = re.sub(r"[^\w.-]+", "-", name).strip("-.") or "mission"
    slug = next(
        slug
        for number in range(1, len(taken) + 2)
        if (slug := plain if number == 1 else f"{plain}-{number}") not in taken
    )
    taken.add(slug)
    return slug


def _draw(record: FlightRecord, folder: Path, times_s: Sequence[float]) -> dict[str, bytes]:
    """Draw all figures of a record: PNG by name."""
    shown_s = [time_s for time_s in times_s if time_s <= record.duration_s]
    shown_s = shown_s or [share * record.duration_s for share in figures.SNAPSHOTS]
    drawn = {
        "snapshots": figures.snapshots(record, shown_s),
        "start-and-end": figures.start_and_end(record),
    }
    if len(record.normalized):
        drawn["cost"] = figures.costs([record])
    drawn["states"] = figures.states(record)
    if record.messages is not None and len(record.messages.heard_at_s):
        drawn["messages"] = figures.messages(record, record.messages)
    if any(record.lateness[loop] for loop in LOOPS):
        drawn["loops"] = figures.loops(record)
    return {name: style.save(figure, folder / name) for name, figure in drawn.items()}
