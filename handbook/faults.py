"""`python -m handbook.faults`: print the drill's tables of docs/faults.md."""

import math
import sys
from itertools import groupby

from edge.flight.margins import ErrorBudget
from handbook.markdown import cell, table
from lpac.sim.drill.bounds import (
    FALLS_M,
    PILOT_NOTICED_S,
    POSITION_ERROR_M,
    TOUCHDOWN_M_S,
    Bound,
    FewCommands,
    RobotGroup,
    always,
)
from lpac.sim.drill.faults import FAULTS, Fault
from lpac.sim.engines import flies


def tables() -> dict[str, str]:
    """The drill's tables as Markdown, by topic."""
    faults = [
        (
            fault.name,
            cell(fault.what),
            cell(fault.promise + (f" (not covered: {fault.uncovered})" if fault.uncovered else "")),
            _bounds(fault),
            *("yes" if flies(engine, fault) else "" for engine in ("mavlink", "px4")),
        )
        for fault in FAULTS.values()
    ]
    return {
        "every flight": table(("in every flight", "limit"), _of_every_flight()),
        "faults": table(("fault", "what happens", "promise", "bounds", "mavlink", "px4"), faults),
    }


def _of_every_flight() -> list[tuple[str, str]]:
    budget = ErrorBudget()
    few = (each for each in always(0.0, "all") if isinstance(each, FewCommands))
    commands = " and ".join(f"{each.limit:g} within {each.within_s:g} s" for each in few)
    return [
        ("distance between two vehicles, unless both stand", f"≥ {budget.drone_m:g} m, their size"),
        ("distance beyond the fence, without a pilot", f"≤ {POSITION_ERROR_M:g} m"),
        ("height above the fence's ceiling, without a pilot", f"≤ {budget.height_m:g} m"),
        ("motors started without a fresh takeoff order to that robot, or twice by one", "none"),
        ("height at which motors stop, without a kill order", f"≤ {FALLS_M:g} m"),
        ("speed at touchdown, without a kill order", f"≤ {TOUCHDOWN_M_S:g} m/s"),
        ("last setpoint to a vehicle after a pilot took it", f"≤ {PILOT_NOTICED_S:g} s"),
        ("commands to a simulated vehicle, requests included", f"≤ {commands}"),
        ("vehicles in the air or armed at the end", "none"),
        ("moments without a known true position", "none"),
    ]


def _bounds(fault: Fault) -> str:
    """Such as "lands ≤ 1.3 s; down ≤ 45 s", with a line per group of robots."""
    bounds = [each for each in fault.bounds if isinstance(each, Bound)]
    assert len(bounds) == len(fault.bounds)
    lines = [
        _group(robots) + "; ".join(map(_bound, group))
        for robots, group in groupby(bounds, lambda bound: bound.robots)
    ]
    if fault.beyond_fence_m != POSITION_ERROR_M:
        lines.append(f"{_group(fault.carried)}beyond the fence ≤ {fault.beyond_fence_m:.3g} m")
    return "<br>".join(lines)


def _group(robots: RobotGroup) -> str:
    return "" if robots == "hit" else f"{robots}: "


def _bound(bound: Bound) -> str:
    sign = "≥" if type(bound).worst is min else "≤"
    limit = f"{bound.told_as} {sign} {bound.limit:.3g} {bound.unit}".rstrip()
    window = (
        f"from {bound.from_s:g} s" if 0.0 < bound.from_s < math.inf else "",
        f"to {bound.until_s:g} s" if bound.until_s < math.inf else "",
        f'after "{bound.after}"' if bound.after else "",
    )
    when = " ".join(filter(None, window))
    return f"{limit} ({when})" if when else limit


if __name__ == "__main__":
    sys.stdout.write("\n\n".join(tables().values()) + "\n")
