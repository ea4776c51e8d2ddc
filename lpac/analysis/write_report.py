"""A report: the paper's figures, one HTML page, and numbers.

Apart from what it is of, which draws nothing: what draws takes a second to load.
"""

import json
import re
from collections.abc import Sequence
from pathlib import Path

from lpac.analysis import figures, style
from lpac.analysis.flight import LOOPS, FlightRecord
from lpac.analysis.logs import Progress
from lpac.analysis.page import Drawn, page
from lpac.analysis.report import Examined

PAGE = "report.html"
SUMMARY = "report.json"


def write(examined: Examined, out: Path, times_s: Sequence[float], progress: Progress) -> Path:
    """Write figures, page and summary to `out`; gives the page. Raises OSError."""
    drawn = []
    slugs: set[str] = set()
    for index, trial in enumerate(examined.trials):
        progress(f"drawing {trial.name}", index / len(examined.trials))
        drawn.append(Drawn(trial, _draw(trial, out / _slug(trial.name, slugs), times_s)))
    repeatability = None
    with_cost = [trial for trial in examined.trials if len(trial.normalized)]
    if len(with_cost) > 1:
        progress("drawing all trials", 1.0)
        repeatability = style.save(figures.repeatability(with_cost), out / "repeatability")
        style.save(figures.costs(with_cost), out / "costs")
    (out / SUMMARY).write_text(json.dumps(examined.summary(), indent=2) + "\n")
    names = ", ".join(trial.name for trial in examined.trials[:3])
    names += ", …" if len(drawn) > 3 else ""
    text = page(f"Flight report: {names}", drawn, repeatability, examined.notes)
    (out / PAGE).write_bytes(text.encode(errors="backslashreplace"))
    return out / PAGE


def _slug(name: str, taken: set[str]) -> str:
    """A folder's name that no other trial has."""
    plain = re.sub(r"[^\w.-]+", "-", name).strip("-.") or "trial"
    slug = next(
        slug
        for number in range(1, len(taken) + 2)
        if (slug := plain if number == 1 else f"{plain}-{number}") not in taken
    )
    taken.add(slug)
    return slug


def _draw(trial: FlightRecord, folder: Path, times_s: Sequence[float]) -> dict[str, bytes]:
    """PNG by figure."""
    shown_s = [time_s for time_s in times_s if time_s <= trial.duration_s]
    shown_s = shown_s or [share * trial.duration_s for share in figures.SNAPSHOTS]
    drawn = {
        "snapshots": figures.snapshots(trial, shown_s),
        "start-and-end": figures.start_and_end(trial),
    }
    if len(trial.normalized):
        drawn["cost"] = figures.costs([trial])
    drawn["states"] = figures.states(trial)
    if trial.messages is not None and len(trial.messages.heard_at_s):
        drawn["messages"] = figures.messages(trial, trial.messages)
    if any(trial.lateness[loop] for loop in LOOPS):
        drawn["loops"] = figures.loops(trial)
    return {name: style.save(figure, folder / name) for name, figure in drawn.items()}
