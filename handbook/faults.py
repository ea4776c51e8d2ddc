"""Generates the reference of the drill's faults and bounds."""

import math
from collections.abc import Sequence
from itertools import groupby, takewhile

from edge.flight.margins import ErrorBudget
from handbook.markdown import cell, table
from lpac.sim.drill.bounds import (
    FALLS_M,
    PILOT_NOTICED_S,
    POSITION_ERROR_M,
    TOUCHDOWN_M_S,
    Bound,
    Criterion,
    FewCommands,
    RobotGroup,
    always,
)
from lpac.sim.drill.faults import ADRIFT, ADRIFT_M, FAULTS, SHARED_BOUNDS, Fault
from lpac.sim.engines import flies

# Names of figures, shorter than in a report; the sign tells a lower limit from an upper one.
_SHORT = {
    "share of the mission": "mission",
    "last of the mission": "ends",
    "leaves the mission": "left",
    "lands no sooner": "lands",
    "speed at rest": "rests",
    "greatest speed": "speed",
    "from where it held": "strays",
    "leaves its height": "height",
    "drift while it lands": "drift",
    "from its pad": "pad",
    "landed apart": "apart",
    "flies at least": "flies",
    "flown beyond the fence": "flown outside",
    "setpoints after the lapse": "setpoints",
}
_READING = """\
A fault hits one robot unless it says all. *M*: mavlink flies it too. *P*: px4 too. Bounds hold for
the robots hit unless they name others; *next* is the robot after them. Bounds are on true values in
s, m and m/s. Time counts from the fault or "after" a later event; [2-5] is a window in s.
[Names](#bounds-by-name) stand for bounds that many faults share.

*mission*: share of the window in which it flies the mission. *ends*, *left*: its last mission
setpoint, counted from the fault or from 2 m below its height. *rests*: speed in hold. *strays*:
distance from where it held. *drift*: distance while landing. *pad*: touchdown from its own pad.
*apart*: distance between landed robots. *height*: off its own. *outside*: how far beyond the fence
the fault may carry it. *flown outside*: time there."""


def page() -> str:
    """Reference of the faults, their promises and the bounds by which a flight is judged."""
    shared = ((f"`{name}`", _text(bounds)) for name, bounds in SHARED_BOUNDS.items())
    adrift = f"outside ≤{ADRIFT_M:.3g}; not covered: {ADRIFT}"
    faults = (
        (
            " ".join(filter(None, (fault.name, _engines(fault)))),
            f"{cell(fault.what)}<br>*{cell(fault.promise)}*",
            _bounds(fault),
        )
        for fault in FAULTS.values()
    )
    return "\n\n".join(
        [
            "# Faults of the drill",
            "[The drill](../drill.md) flies these faults. Declared in "
            "[`faults.py`](../../lpac/sim/drill/faults.py); `lpac drill --list` prints them "
            "without bounds.",
            "## In every flight",
            table(("figure", "limit"), _of_every_flight()),
            "## By fault",
            _READING,
            table(("fault", "what happens, *promise*", "bounds"), faults),
            "## Bounds by name",
            table(("name", "bounds"), (*shared, ("`adrift`", adrift))),
        ]
    )


def _engines(fault: Fault) -> str:
    """M and P for the engines mavlink and px4, if they fly it."""
    return "M" * flies("mavlink", fault) + "P" * flies("px4", fault)


def _of_every_flight() -> list[tuple[str, str]]:
    budget = ErrorBudget()
    few = (each for each in always(0.0, "all") if isinstance(each, FewCommands))
    commands = " and ".join(f"{each.limit:g} within {each.within_s:g} s" for each in few)
    return [
        ("between two vehicles, unless both stand", f"≥{budget.drone_m:g} m, their size"),
        ("beyond the fence, without a pilot", f"≤{POSITION_ERROR_M:g} m"),
        ("above the ceiling, without a pilot", f"≤{budget.height_m:g} m"),
        ("motors started without a fresh takeoff order, or twice by one", "none"),
        ("motors stop, without a kill order, at", f"≤{FALLS_M:g} m"),
        ("touchdown, without a kill order, at", f"≤{TOUCHDOWN_M_S:g} m/s"),
        ("last setpoint after a pilot took it", f"≤{PILOT_NOTICED_S:g} s"),
        ("commands to a simulated vehicle", f"≤{commands}"),
        ("in the air or armed at the end", "none"),
        ("moments without a known true position", "none"),
    ]


def _bounds(fault: Fault) -> str:
    """Such as "`others-fly`; lands ≤1.3", shared bounds by their codes."""
    parts: list[str] = []
    rest = fault.bounds
    while rest:
        found = (name for name, shared in SHARED_BOUNDS.items() if rest[: len(shared)] == shared)
        name = next(found, None)
        count = len(SHARED_BOUNDS[name]) if name else _alike(rest)
        parts.append(f"`{name}`" if name else _text(rest[:count]))
        rest = rest[count:]
    adrift = fault.uncovered == ADRIFT and fault.beyond_fence_m == ADRIFT_M
    if adrift:
        parts.append("`adrift`")
    elif fault.beyond_fence_m != POSITION_ERROR_M:
        parts.append(f"{_group(fault.carried)}outside ≤{fault.beyond_fence_m:.3g}")
    if fault.uncovered and not adrift:
        parts.append(f"not covered: {cell(fault.uncovered)}")
    return _join(parts)


def _alike(bounds: tuple[Criterion, ...]) -> int:
    """Count the first bounds that are of one group and have no code."""
    robots = _bound(bounds[0]).robots
    shared = {group[0] for group in SHARED_BOUNDS.values() if len(group) == 1}
    same = takewhile(lambda each: _bound(each).robots == robots and each not in shared, bounds)
    return sum(1 for _ in same)


def _text(bounds: tuple[Criterion, ...]) -> str:
    """Such as "lands ≤1.3; down ≤45<br>others: pad ≤3"."""
    groups = groupby(map(_bound, bounds), lambda bound: bound.robots)
    return _join([_group(robots) + "; ".join(map(_bound_text, group)) for robots, group in groups])


def _join(parts: Sequence[str]) -> str:
    """Join parts; one that names its robots is a line of its own."""
    text, named = "", False
    for part in parts:
        starts_line = named or ": " in part
        text += ("<br>" if starts_line else "; ") * bool(text) + part
        named = ": " in part
    return text


def _group(robots: RobotGroup) -> str:
    return "" if robots == "hit" else f"{robots}: "


def _bound(criterion: Criterion) -> Bound:
    assert isinstance(criterion, Bound)
    return criterion


def _bound_text(bound: Bound) -> str:
    sign = "≥" if type(bound).worst is min else "≤"
    limit = f"{_SHORT.get(bound.figure_name, bound.figure_name)} {sign}{bound.limit:.3g}"
    begins, ends = max(bound.from_s, 0.0), bound.until_s
    window = ""
    if begins or ends < math.inf:
        window = f" [{begins:g}-{ends:g}]" if ends < math.inf else f" [{begins:g}-]"
    return limit + window + (f" after {bound.after}" if bound.after else "")
