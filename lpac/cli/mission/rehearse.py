"""`lpac mission rehearse`: carry a robot over the field, and see its position and command."""

import json
import math
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.ground_requests import address, subscribe
from lpac.cli.options import DEFAULT_FLEET, Fleet, Robots
from lpac.cli.printing import BAD, FAINT, NOTABLE, styled

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.table import Table
    from rich.text import Text

    from lpac.ground.station.subscriber import GroundSubscriber

_PERIOD_S = 1.0
_HEADINGS = ("robot", "x m", "y m", "nose", "fence m", "commanded", "from its nose")


def rehearse(
    fleet: Fleet = DEFAULT_FLEET,
    robots: Robots = None,
    seconds: Annotated[
        float, typer.Option("--seconds", min=0, help="How long; else until Ctrl-C.")
    ] = math.inf,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object a line, once a second.")
    ] = False,
) -> None:
    """Show disarmed robots' estimated positions, and where the policy would fly them.

    The arrow is in the mission frame, y up; the words are relative to the robot's nose.
    """
    from lpac.ground.station.subscriber import addressed

    to = address(fleet, robots)
    with subscribe(to) as subscriber:
        names = addressed(subscriber.setup, to.robots)
        _require_disarmed(subscriber, names)
        try:
            _watch(subscriber, names, subscriber.now_s + seconds, as_json=as_json)
        except KeyboardInterrupt:
            return


def _watch(
    subscriber: "GroundSubscriber", names: "Sequence[str]", end_s: float, *, as_json: bool
) -> None:
    from rich.console import Console
    from rich.live import Live

    console = Console(highlight=False, markup=False)
    live = Live(
        get_renderable=lambda: _table(subscriber, names), console=console, refresh_per_second=5
    )
    if console.is_terminal and not as_json:
        live.start()
    try:
        while subscriber.now_s < end_s:
            if as_json:
                _print_json(subscriber, names)
            elif not console.is_terminal:
                for row in _rows(subscriber, names):
                    console.print(_line(row), soft_wrap=True)
            wait_s = min(_PERIOD_S, end_s - subscriber.now_s)
            subscriber.wait_for(lambda _: False, max(0.0, wait_s))
            _require_disarmed(subscriber, names)
    finally:
        live.stop()


def _print_json(subscriber: "GroundSubscriber", names: "Sequence[str]") -> None:
    from lpac.ground.rehearsal import carried_robot

    for robot in subscriber.snapshot.robots:
        if robot.name in names and robot.status is not None and robot.fresh:
            seen = carried_robot(robot.status, subscriber.setup.fence)
            commanded = seen.commanded and seen.commanded._asdict()
            line = {"robot": robot.name, **seen._asdict(), "commanded": commanded}
            typer.echo(json.dumps(line))


def _require_disarmed(subscriber: "GroundSubscriber", names: "Sequence[str]") -> None:
    armed = [
        robot.name
        for robot in subscriber.snapshot.robots
        if robot.name in names and robot.status is not None and robot.status.armed
    ]
    if armed:
        raise ValueError(f"rehearse: {', '.join(armed)}: armed: carry disarmed robots only")


def _table(subscriber: "GroundSubscriber", names: "Sequence[str]") -> "Table":
    from rich.table import Table

    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    for heading in _HEADINGS:
        number = heading in ("x m", "y m", "nose", "fence m")
        table.add_column(heading, justify="right" if number else "left")
    for row in _rows(subscriber, names):
        table.add_row(*row)
    return table


def _line(row: "list[Text]") -> str:
    """A row of the table as text: "r1: x 4.5 m, y 2.0 m, ..."."""
    robot, *cells = map(str, row)
    if len(cells) < len(_HEADINGS) - 1:
        return f"{robot}: {cells[0]}"
    x, y, nose, fence_m, arrow, words = cells
    parts = [
        f"x {x} m, y {y} m" if y else x,
        f"nose {nose}" if nose else "",
        f"inside the fence by {fence_m} m" if fence_m else "",
        f"commanded: {arrow} {words}".rstrip(),
    ]
    return f"{robot}: {', '.join(filter(None, parts))}"


def _rows(subscriber: "GroundSubscriber", names: "Sequence[str]") -> list[list["Text"]]:
    from lpac.ground.rehearsal import carried_robot

    rows = []
    for robot in subscriber.snapshot.robots:
        if robot.name not in names:
            continue
        if robot.status is None or not robot.fresh:
            rows.append([styled(robot.name, ""), styled("not heard", BAD)])
            continue
        seen = carried_robot(robot.status, subscriber.setup.fence)
        if seen.position_m is None:
            why = "no origin" if robot.status.origin is None else "no position"
            x, y, inside = styled(why, NOTABLE), styled("", ""), styled("", "")
        else:
            x, y = (styled(f"{value:.1f}", "") for value in seen.position_m)
            fence_m = seen.fence_m or 0.0
            inside = styled(f"{fence_m:.1f}", BAD if fence_m < 0.0 else "")
        rows.append([
            styled(robot.name, ""),
            x,
            y,
            styled("" if seen.nose_deg is None else f"{round(seen.nose_deg) % 360} deg", ""),
            inside,
            styled("no answer", FAINT) if seen.commanded is None
            else styled(seen.commanded.arrow, "bold"),
            styled("" if seen.commanded is None else seen.commanded.words, ""),
        ])  # fmt: skip
    return rows
